"""Transforms between the frames of the robot (TF)."""
