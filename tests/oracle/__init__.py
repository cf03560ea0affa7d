"""The oracle: a slow and plain implementation of a whole tick from measurement to command, to verify the product.

It shares with the product the velocity models, the configuration, the tables of references, re-entry and result types.
Everything else is independent: derivatives come from complex steps, the quadratic program is solved with all its limits
at every tick and its solution is certified, trajectories are sampled in NumPy.
"""
