"""Tracking problem: formulas in CasADi, constants of the core by name, and user-defined terms."""
