"""One thin rclpy node a file: convert, call core, publish."""

import thinmap_ros.startup  # noqa: F401  before all other modules
