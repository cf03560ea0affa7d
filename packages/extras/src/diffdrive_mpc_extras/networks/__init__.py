"""Velocity models that are networks on past commands: architecture, file, evaluation, training."""
