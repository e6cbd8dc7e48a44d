"""Requests of a page as goals, calls, poses and velocities."""
