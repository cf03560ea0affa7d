"""Worlds: what stands and moves around the robot, what touches it, and what it sees of that."""
