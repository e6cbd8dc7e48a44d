"""Contradictions between scans, odometry, and the pose of the laser on the robot."""
