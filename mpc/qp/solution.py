"""What a solve gives back."""

from __future__ import annotations

from dataclasses import dataclass

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.solver_report import SolverReport


@dataclass(frozen=True, slots=True)
class Solution:
    """A plan and what the solver says of it; the plan means nothing unless `report.status.usable`.

    Attributes
    ----------
    plan
        (N, 2) v_ref [m/s], omega_ref [rad/s] for the next N ticks.
    report
        Status, iterations, residuals.
    """

    plan: FloatArray
    report: SolverReport
