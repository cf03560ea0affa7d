"""Metrics of a run: errors of the true pose along and across the path, and recovery."""
