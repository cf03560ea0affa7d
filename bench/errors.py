"""Errors that the bench itself can find."""

from __future__ import annotations

from diffdrive_mpc.models.errors import DiffdriveMpcError


class NotReproducibleError(DiffdriveMpcError, RuntimeError):
    """The same measurements gave other commands when they were replayed."""
