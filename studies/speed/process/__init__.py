"""Persistent processes that solve the problem on request, and the virtual environment of peers."""
