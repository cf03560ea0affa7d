"""Compiled C: how it is made, kept and shipped; the controller's core and the simulated robot's drivetrain use it."""
