"""Identification seen from the command line: figures, known truths, the papers' experiments."""

from __future__ import annotations
