"""Results of an identification: configuration, report and tables."""
