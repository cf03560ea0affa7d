"""From an unknown robot to a proven controller: the chain, its gates, and drawn robots to try it on."""
