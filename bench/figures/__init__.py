"""Figures of runs and experiments: matplotlib without a display, readable in print and with any colour vision."""
