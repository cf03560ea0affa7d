"""Solvers beside the core's own ways: one interface, a backend each for OSQP and DAQP, and what they report."""
