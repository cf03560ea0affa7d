"""What a turn costs a robot, from a log of it."""
