"""Command line and the implementations of its commands."""
