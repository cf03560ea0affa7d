"""Drives as MCAP files: ROS 2 messages on the topics of node and robot, and a row of values per tick."""
