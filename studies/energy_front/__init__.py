"""What a cost of energy in the controller saves, and what it costs in tracking error."""
