"""Comparison by `diffdrive-mpc bench`: controllers, models and settings on trajectories, and horizons."""
