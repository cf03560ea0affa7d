"""Comparison of identified model structures on logs."""
