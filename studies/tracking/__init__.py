"""The tracking study: what was asked for, what each part of the estimator is worth, and how much is left."""
