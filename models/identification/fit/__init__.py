"""Fit of a model to records, scores, sensor noise, and calibration from poses."""
