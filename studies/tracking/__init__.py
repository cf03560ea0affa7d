"""Tracking study: targets, the effect of each part of the estimator, and the remaining margin."""
