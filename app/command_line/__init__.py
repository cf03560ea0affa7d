"""Common parts of all command lines: one-line errors, and options."""
