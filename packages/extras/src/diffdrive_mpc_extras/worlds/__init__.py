"""Worlds: obstacles and persons around the robot, contacts, and the robot's view of them."""
