"""Compiled C: compilation, cache and packaging; the controller's core and the simulated robot's drivetrain use it."""
