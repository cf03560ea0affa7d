"""One drive or laps of one, from the command line: summary, report, log, and a run of a proof driven again."""
