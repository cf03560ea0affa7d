"""The hook by which features attach to a controller, and the features of a configuration."""
