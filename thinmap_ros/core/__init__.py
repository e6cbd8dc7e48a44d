"""The papers' algorithms as NumPy and numba code: no ROS, no files, no clock, no global random state."""
