"""The monitor as a ROS 2 process of its own."""
