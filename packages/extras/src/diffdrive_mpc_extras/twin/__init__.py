"""The digital twin of a user's robot: the physics fitted to a log of it."""
