"""Costs of turns of a robot, identified from its log."""
