"""Disturbances of a run: named scenarios with seeded random values, and plants with disturbances."""
