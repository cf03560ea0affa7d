"""Modules of the commands; the dependencies of a command are imported when it is run."""
