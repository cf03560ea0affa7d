"""Worlds: obstacles and persons around the robot, their contacts with it, and obstacle sensors."""
