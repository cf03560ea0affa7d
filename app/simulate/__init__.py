"""One drive from the command line: summary, report and log."""
