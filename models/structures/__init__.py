"""The structures of velocity models: of each its parameter file, and how it is found from records."""
