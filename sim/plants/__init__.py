"""Simulated robots: MuJoCo with a drivetrain, and velocity models with slip."""
