"""EKF-SLAM on line features, with a prediction that is sharpened by matching each scan against the map of points."""
