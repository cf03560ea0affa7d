"""Types of ROS messages that have no wheel, generated from their definitions in `interfaces/` and compiled."""
