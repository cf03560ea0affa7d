"""The common base of all errors that the project defines."""

from __future__ import annotations


class DiffdriveMpcError(Exception):
    """What the project itself refuses or cannot do; the message is one line: place, mistake, remedy.

    Most of its kinds are a ValueError or a RuntimeError too. An argument that no caller of a correct program gives (the
    wrong shape of an array) raises a plain ValueError, which is none of them.
    """


class MissingPackageError(DiffdriveMpcError, ImportError):
    """Something was asked for that needs a package which is not installed; says how to install it."""
