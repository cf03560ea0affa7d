"""Simulated robot as a ROS 2 node. Only this folder of `sim` imports rclpy."""
