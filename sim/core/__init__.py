"""Drivetrain of the simulated robot in C, and its compilation and loading."""
