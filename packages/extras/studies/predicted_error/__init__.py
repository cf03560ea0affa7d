"""The calibration of the predicted error, and how far it holds on drives that played no part in it."""
