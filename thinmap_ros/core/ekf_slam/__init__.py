"""EKF-SLAM/TI (third paper): EKF-SLAM on line features of a topological local area."""
