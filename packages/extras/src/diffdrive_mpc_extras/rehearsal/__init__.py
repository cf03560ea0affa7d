"""Iterative learning on repeated paths: errors that repeat from lap to lap are corrected."""
