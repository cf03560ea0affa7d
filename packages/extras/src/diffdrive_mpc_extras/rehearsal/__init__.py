"""Drive the same path again: errors that repeat from lap to lap are learned."""
