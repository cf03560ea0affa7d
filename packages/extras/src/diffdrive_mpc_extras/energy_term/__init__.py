"""What turning costs, in the cost and as a least radius."""
