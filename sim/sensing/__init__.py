"""Sensors of the plants: rates, noise, bias and latency, and shipped sensor sets."""
