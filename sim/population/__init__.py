"""Robots as wide as the market, drawn from seeds: what a controller has to hold for that was made on one of them."""
