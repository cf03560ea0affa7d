"""Base class of features that attach to a controller, and the lookup of the features of a configuration."""
