"""Simulator: world, robot and laser in fixed time steps, without ROS, reproducible by seed."""
