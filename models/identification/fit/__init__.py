"""Records to a model and its scores; what poses and noise add."""
