"""Comparison of identified model kinds on logs."""
