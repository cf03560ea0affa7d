"""Conversion of planner paths, which are poses without times: interpretation, smoothing within a tube, and timing."""
