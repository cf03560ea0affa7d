"""Tracking controllers for comparison in the bench: Kanayama, MPPI, regulated pure pursuit, and obstacle avoidance."""
