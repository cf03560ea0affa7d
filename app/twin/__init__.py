"""`diffdrive-mpc twin`: a plant fitted to a log of a robot."""
