"""Whether the parameters for other packages that a log tells are right, and their intervals wide enough."""
