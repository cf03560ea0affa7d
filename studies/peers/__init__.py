"""Study `peers`: tune every peer by the same search on the same runs with the same budget, and check the optimum."""
