"""Frames of a robot: static and moving transforms, mounts of lasers, frames of odometry."""
