"""What can go wrong in a study that is no mistake of the user's; each is one line."""

from __future__ import annotations

from diffdrive_mpc.models.errors import DiffdriveMpcError


class StudyFailedError(DiffdriveMpcError, RuntimeError):
    """A study could not be finished."""


class NotReproducibleError(StudyFailedError):
    """The same measurements gave other commands when they were replayed."""


class WorkerDiedError(StudyFailedError):
    """A process that ran a part of a study ended without a result."""
