"""EKF-SLAM on line features; matching scans with the map of points sharpens predictions."""
