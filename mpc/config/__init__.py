"""The configuration of a controller: one typed schema, its files, and the shipped ones."""
