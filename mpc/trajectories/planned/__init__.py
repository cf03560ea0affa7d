"""Conversion of planner paths, which have poses but no times: interpretation, smoothing within a tube, and timing."""
