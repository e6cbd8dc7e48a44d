"""Robots, or one, that explore a simulated world in a closed loop, without ROS."""
