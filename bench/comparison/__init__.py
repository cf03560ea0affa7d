"""Comparison of controllers, models, settings and horizons by `diffdrive-mpc bench`."""
