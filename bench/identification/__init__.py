"""`diffdrive-mpc identify`: from logs to a folder with a model, a configuration, a report and figures."""
