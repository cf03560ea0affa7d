"""Replay of the ticks of a recorded drive, and comparison of the commands."""
