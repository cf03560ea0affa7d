"""What is there on this computer, what it means for the controller, and what to do about it."""
