"""What an identification hands over: configuration, report, tables."""
