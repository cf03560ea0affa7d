"""Identification of the shipped models, calibration of the simulated robot, and tests with known parameters."""
