"""Drivetrain of the simulated robot in C, with build and loading."""
