"""Implementation of `diffdrive-mpc simulate`: summary, report and log."""
