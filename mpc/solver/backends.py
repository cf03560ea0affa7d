"""The solvers that may be asked, by their names in the configuration (`solver.backend`)."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module

from diffdrive_mpc.mpc.solver.backend import Backend

BACKENDS: Mapping[str, str] = {"daqp": "DaqpBackend", "osqp": "OsqpBackend"}
"""Class of each backend; its module is `mpc.solver.NAME_backend`."""


def load_backend(name: str) -> type[Backend]:
    """Import the backend `name`: a solver's library is loaded only where the configuration names it."""
    backend: type[Backend] = getattr(import_module(f"{__package__}.{name}_backend"), BACKENDS[name])
    return backend
