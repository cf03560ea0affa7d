"""Dead time that is learned while the robot drives."""
