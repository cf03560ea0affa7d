"""Calibration of the predicted error, and its coverage on held-out drives."""
