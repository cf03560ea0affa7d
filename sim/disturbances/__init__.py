"""Disturbances of a run: named, seeded scenarios, and the plant that undergoes them."""
