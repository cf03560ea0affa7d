"""Controllers of other kinds, to compare the predictive controller with."""
