"""The compiled core: hand-written C for algebra and state, generated C for all formulas, and the library's loader."""
