"""A reference from pose to pose that takes the least energy, time or distance, with what it is predicted to take."""
