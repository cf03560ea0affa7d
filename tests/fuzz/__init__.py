"""Fuzzers of the root package with odd input from seeds; see CONTRIBUTING.md.

A fuzzer draws cases, plain values that JSON can hold, and checks the promises of the product. Hypothesis draws them
from a seed and reduces a finding. `findings/` holds the corrected ones, the first examples of every run.
"""
