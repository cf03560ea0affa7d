"""ROS 2 node of the controller. Modules of this package import rclpy only if they need it."""
