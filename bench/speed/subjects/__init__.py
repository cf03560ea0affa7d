"""Who solves the problem: our controller, and peers that get it stage by stage."""
