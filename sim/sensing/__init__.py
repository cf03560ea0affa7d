"""Sensors of the plants, with rates, noise, bias and latency, and built-in sensor sets."""
