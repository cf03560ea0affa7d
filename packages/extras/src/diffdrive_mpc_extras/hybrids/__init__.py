"""An identified linear model with a small network on what it leaves, which is silent where data are thin."""
