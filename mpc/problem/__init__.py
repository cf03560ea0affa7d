"""The tracking problem: its formulas in CasADi, its constants by name, and the user's terms."""
