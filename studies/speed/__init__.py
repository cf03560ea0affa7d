"""Step time of the controller, compared with peers on the same problem."""
