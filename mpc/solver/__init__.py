"""Backend solvers besides the core's own methods: an interface, backends for OSQP and DAQP, and their reports."""
