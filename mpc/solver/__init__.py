"""Backend solvers in addition to the core's methods: an interface, backends for OSQP and DAQP, and solver reports."""
