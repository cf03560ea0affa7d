"""ROS 2 bags as logs."""
