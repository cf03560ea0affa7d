"""What the controller believes of the robot: pose, twist and slip, each with its uncertainty."""
