"""What a turn costs: torque, least radius, what is learned of them, power and energy, on the simulated robot."""
