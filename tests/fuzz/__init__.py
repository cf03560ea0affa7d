"""Fuzzers of the root package; see CONTRIBUTING.md.

A fuzzer draws cases, which are JSON values, and checks the guarantees of the project. Hypothesis draws them from a seed
and reduces a failing case. `findings/` contains the fixed findings, which are the first examples of every run.
"""
