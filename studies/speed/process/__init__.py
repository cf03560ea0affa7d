"""Persistent processes that solve the problem on request, and the environment of those that need their own."""
