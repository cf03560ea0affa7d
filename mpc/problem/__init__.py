"""The tracking problem: its formulas in CasADi, its numbers by name, and the terms of the user."""
