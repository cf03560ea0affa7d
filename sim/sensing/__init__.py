"""Sensors of the plants: rates, noise, bias and latency, and the sets of them that ship."""
