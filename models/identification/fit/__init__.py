"""Records to a model and its scores; results from poses, and noise."""
