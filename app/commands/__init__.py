"""One module for each command of the command line; what a command needs is imported when it runs."""
