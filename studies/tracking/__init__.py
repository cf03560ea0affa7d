"""Tracking study: targets, effect of each part of the estimator, and remaining potential for improvement."""
