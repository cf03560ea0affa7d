"""What can be attached to a controller, and where each feature is found."""
