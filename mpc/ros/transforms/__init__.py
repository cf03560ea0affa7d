"""Transforms between frames: storage for several seconds, lookup along chains, and checks."""
