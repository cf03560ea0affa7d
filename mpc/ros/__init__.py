"""ROS 2 node of the controller; only modules that need rclpy import it."""
