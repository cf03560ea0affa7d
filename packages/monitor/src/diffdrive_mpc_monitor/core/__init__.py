"""The judge in C, for the monitor and for a microcontroller."""
