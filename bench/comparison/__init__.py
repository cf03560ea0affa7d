"""What `diffdrive-mpc bench` compares: controllers, models and settings on trajectories, and horizons."""
