"""The EKF paper's figures, and logs of real robots."""
