"""The oracle: a slow, simple implementation of a whole tick from measurement to command, to verify the product.

Oracle and product share velocity models, configuration, tables of references, re-entry and result types. The rest is
independent: derivatives are computed by complex steps, the quadratic program is solved with all limits at every tick,
its solution is certified, and trajectories are sampled with NumPy.
"""
