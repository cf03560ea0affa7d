"""How fast the closed loop is simulated, whole and by part."""
