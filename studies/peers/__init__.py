"""Study `peers`: tune every peer by the same search with one budget on the same runs, and check the optimum."""
