"""The controller as a ROS 2 node. rclpy is imported only here and only by the modules that need it."""
