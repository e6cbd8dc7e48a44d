"""Everything that touches the outside: ROS, bags, logs, image files, pictures.

One file an outside thing.
"""
