"""Optimised excitation drives for identification."""
