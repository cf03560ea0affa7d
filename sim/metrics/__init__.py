"""How well a run tracked: errors against the true pose, along and across the path, and recovery."""
