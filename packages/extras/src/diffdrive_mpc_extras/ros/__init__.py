"""ROS 2 node parts: topics and services of the features in this package."""
