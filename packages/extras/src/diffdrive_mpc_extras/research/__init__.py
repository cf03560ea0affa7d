"""Tools for research on tracking: an environment with the Gymnasium API, and a table of many closed-loop drives."""
