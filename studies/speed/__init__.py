"""Speed of a step, compared with peers on the same problem."""
