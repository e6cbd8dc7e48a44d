"""The papers' algorithms as NumPy and numba code.

No ROS, no files, no clock, no global random state.
"""
