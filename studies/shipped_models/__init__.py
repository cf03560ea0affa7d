"""Identification of the shipped models, calibration of the simulated robot, and tests on known parameters."""
