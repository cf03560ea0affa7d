"""The papers' experiments on the simulated robot, compared with the papers' figures."""
