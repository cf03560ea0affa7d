"""Tuning of a controller: a search over its configuration, and a verdict on runs that the search has not seen."""
