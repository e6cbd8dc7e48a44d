"""A small `ros2` on rclpy: the verbs that thinmap needs, with the output of the real one.

If the real one is installed, it precedes this one on PATH, which is then never run.
"""
