"""Structures of velocity models: their parameter files, and their identification from records."""
