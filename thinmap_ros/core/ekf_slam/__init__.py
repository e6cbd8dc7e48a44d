"""The third paper: EKF-SLAM on line features of the local area, picked by topology."""
