"""Export of the controller as C99: the sources of the core with the sizes and constants of one configuration."""
