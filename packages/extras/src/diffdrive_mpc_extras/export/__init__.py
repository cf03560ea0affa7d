"""The controller as C99 for a microcontroller: the core's sources with the sizes and constants of a configuration."""
