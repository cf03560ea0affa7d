"""Repeat the ticks of a recorded drive and compare the commands."""
