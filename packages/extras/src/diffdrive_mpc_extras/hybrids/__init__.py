"""An identified linear model with a small network for its residuals, which is zero where data are sparse."""
