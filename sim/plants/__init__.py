"""The stand-ins for the robot: MuJoCo with its drivetrain, and velocity models with slip."""
