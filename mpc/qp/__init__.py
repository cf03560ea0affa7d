"""The condensed quadratic program and its solvers: one interface, a backend each for OSQP and DAQP."""
