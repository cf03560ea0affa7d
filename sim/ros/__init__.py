"""ROS 2 node of the simulated robot. Only this folder of `sim` imports rclpy."""
