"""A drive as an MCAP file: ROS 2 messages on the topics of node and robot, and a row of numbers at each tick."""
