"""Research on tracking: an environment with the Gymnasium API, and many closed-loop drives as a table."""
