"""A small `ros2` on rclpy: the verbs that a robot with thinmap needs, spoken as the real one does.

The real one, where there is one, comes first on PATH: this one is then never run.
"""
