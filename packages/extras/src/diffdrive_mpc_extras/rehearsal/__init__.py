"""Drive the same path again: what repeats from lap to lap is learned."""
