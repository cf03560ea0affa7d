"""Paths of a planner, poses without times: read, smoothed inside a distance, and timed."""
