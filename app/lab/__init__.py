"""The laboratory: the controller, a simulated robot and a peer as one page for a browser."""
