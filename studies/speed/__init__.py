"""How fast a step is, beside peers on the same problem."""
