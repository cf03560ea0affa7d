"""One module for each command of the command line; dependencies of a command are imported when it runs."""
