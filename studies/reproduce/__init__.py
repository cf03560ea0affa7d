"""Experiments of the papers on the simulated robot, compared with the published values."""
