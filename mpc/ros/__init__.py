"""The controller as a ROS 2 node. Only modules of this package that need rclpy import it."""
