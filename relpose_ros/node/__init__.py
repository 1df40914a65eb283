"""The ROS graph around a scanner: the lifecycle node, the only code that imports rclpy."""
