"""Study of step times: the controller, compared with peers on the same problem."""
