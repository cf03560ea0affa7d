"""Digital twin of a robot: the MuJoCo plant fitted to logs."""
