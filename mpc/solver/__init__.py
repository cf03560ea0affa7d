"""Backend solvers in addition to the methods of the core: interface, OSQP and DAQP backends, and solver reports."""
