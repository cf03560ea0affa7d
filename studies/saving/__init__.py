"""How much energy an energy-optimal path saves, driven in closed loop on the simulated robot."""
