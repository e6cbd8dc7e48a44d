"""A world, a robot and a laser, stepped by hand: no ROS, seeded, as fast as the machine goes."""
