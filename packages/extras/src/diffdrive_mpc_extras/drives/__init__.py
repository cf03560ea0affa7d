"""Models of a drive with dead time, slope limits and a standstill threshold, and of its wheels under PI control."""
