"""Velocity models that are recurrent networks on past commands: architecture, file, evaluation, training."""
