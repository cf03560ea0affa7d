"""Solvers in addition to the methods of the core: interface, backends for OSQP and DAQP, and solver reports."""
