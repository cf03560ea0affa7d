"""The drivetrain of the simulated robot in C, and what builds and loads it."""
