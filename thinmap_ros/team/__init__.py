"""Several robots that explore one simulated world together, without ROS."""
