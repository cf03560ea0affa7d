"""The papers' experiments on the simulated robot, beside the papers' figures."""
