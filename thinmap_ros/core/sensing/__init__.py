"""Scans as the rest of the core uses them: paired with odometry, checked, at one instant."""
