"""Fit of a model to records, with scores, sensor noise and calibration from poses."""
