"""Optimised excitation of a robot for identification."""
