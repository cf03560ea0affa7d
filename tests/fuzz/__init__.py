"""Fuzzers of the root package with odd input from seeds; see CONTRIBUTING.md.

A fuzzer draws cases, plain values that JSON can hold, from a seed and a number, checks the promises of the product, and
reduces a case. The runner limits count, time and memory, reduces findings and adds them to `findings/`, which
`test_fuzzers.py` replays.
"""
