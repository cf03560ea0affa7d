"""Tracking controllers that avoid obstacles or sample trajectories, for comparison in the bench."""
