"""The tracking error of a reference before it is driven: tubes in which a stated share of drives stays."""
