"""Hybrid model: an identified linear model with a small network for its residuals, which is zero far from the data."""
