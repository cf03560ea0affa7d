"""Paths of a planner, which are poses without times: interpretation, smoothing within a distance, and timing."""
