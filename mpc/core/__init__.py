"""Compiled core: hand-written C code for algebra and state, generated C code for all formulas, and loading of both."""
