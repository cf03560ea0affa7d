"""Metrics of a run: tracking errors of the true pose, and recovery."""
