"""The oracle: the whole tick from measurement to command, slow and plain, for the product to be held against.

It shares with the product the velocity models, the configuration, the references' tables, re-entry and the types of its
results. Everything else is its own: derivatives come from complex steps, the quadratic program is solved with all its
limits at every tick and its solution certified, trajectories are sampled in numpy.
"""
