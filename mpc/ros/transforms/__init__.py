"""Transforms between frames: storage of recent transforms, lookup along chains, and checks."""
