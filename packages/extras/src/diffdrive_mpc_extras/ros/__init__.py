"""Parts of the ROS 2 nodes: topics and services of the features in this package."""
