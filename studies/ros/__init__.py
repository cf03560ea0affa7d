"""The node and the simulated robot as two processes, compared with the simulation in one."""
