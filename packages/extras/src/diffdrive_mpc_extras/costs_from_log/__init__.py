"""Energy costs of a robot's turns, identified from a log."""
