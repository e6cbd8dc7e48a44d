"""One thin rclpy node a file: convert, call core, publish."""
