"""Cases that need no ROS graph."""
