"""Command line, and the functions behind each of its commands."""
