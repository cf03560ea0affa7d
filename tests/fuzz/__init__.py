"""Fuzzers: what nobody would type, send or configure on purpose, drawn from seeds. See CONTRIBUTING.md.

Each fuzzer draws cases, which are plain values that JSON can hold, from a seed and a number; looks whether the product
keeps what it promises; and can make a case smaller. The runner bounds count, time and memory, minimises what was
found, and keeps it as a file in `findings/`, which `test_findings.py` replays ever after.
"""
