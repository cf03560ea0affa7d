"""One experiment each, from drives to numbers."""
