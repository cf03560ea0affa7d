"""Figures of the papers' experiments repeated."""
