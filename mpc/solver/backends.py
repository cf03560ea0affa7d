"""The solvers that may be asked, by their names in the configuration (`solver.backend`)."""

from __future__ import annotations

from collections.abc import Mapping

from diffdrive_mpc.mpc.solver.backend import Backend
from diffdrive_mpc.mpc.solver.daqp_backend import DaqpBackend
from diffdrive_mpc.mpc.solver.osqp_backend import OsqpBackend

BACKENDS: Mapping[str, type[Backend]] = {"osqp": OsqpBackend, "daqp": DaqpBackend}
