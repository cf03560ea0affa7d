"""Configuration of a controller: typed schema, reading of files, and the built-in configurations."""
