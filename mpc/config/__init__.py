"""Configuration of a controller: schema, loading of files, and built-in configurations."""
