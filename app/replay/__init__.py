"""Recorded measurements through a controller, open loop: what it would have commanded beside what was commanded."""
