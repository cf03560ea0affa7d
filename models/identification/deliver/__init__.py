"""Results of an identification: configuration, report, tables."""
