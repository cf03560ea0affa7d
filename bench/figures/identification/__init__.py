"""Figures of an identification."""
