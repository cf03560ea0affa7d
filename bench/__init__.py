"""Comparison of controllers: cases, runs, peers, tables and report."""
