"""Errors that the bench itself can find."""

from __future__ import annotations


class NotReproducibleError(RuntimeError):
    """The same measurements gave other commands when they were replayed."""
