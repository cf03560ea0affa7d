"""Common parts of all command lines: one-line error messages and options."""
