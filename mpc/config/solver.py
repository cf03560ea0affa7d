"""The schema of how the problem is solved."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from diffdrive_mpc.mpc.config.group import Group


class Osqp(Group):
    """OSQP's own settings, by its names, where `solver.method` is osqp."""

    eps_abs: Annotated[float, Field(ge=1e-9, le=1e-2)] = Field(
        1e-6, description="absolute tolerance of OSQP on its residuals [-]"
    )
    eps_rel: Annotated[float, Field(ge=1e-9, le=1e-2)] = Field(
        1e-6, description="relative tolerance of OSQP on its residuals [-]"
    )
    max_iter: Annotated[int, Field(ge=10, le=100_000)] = Field(
        4000, description="limit of the iterations of one solve of OSQP [-]"
    )
    check_termination: Annotated[int, Field(ge=1, le=1000)] = Field(
        10, description="iterations of OSQP between two checks of its residuals [-]"
    )


class Solver(Group):
    """Solver of the quadratic program."""

    method: Literal["auto", "osqp", "daqp"] = Field(
        "auto",
        description="auto: the minimiser without limits where it keeps them, then the active set, and DAQP where that "
        "is not proven; osqp: OSQP at every tick; daqp: DAQP at every tick [-]",
    )
    active_set_iterations: Annotated[int, Field(ge=0, le=5000)] = Field(
        500,
        description="systems that the active set may solve at a tick; then its plan is taken as it is, with ranges and "
        "slew kept; 0: ask DAQP at once [-]",
    )
    max_iterations: Annotated[int, Field(ge=10, le=100_000)] = Field(
        2000, description="limit of the iterations of one solve of DAQP [-]"
    )
    tolerance: Annotated[float, Field(ge=1e-9, le=1e-2)] = Field(
        1e-5,
        description="of DAQP on the limits, in units of rows normalised by the cost; a tenth of it counts as kept for "
        "every solver [-]",
    )
    time_limit: Annotated[float, Field(gt=0)] | None = Field(
        None,
        description="the node's: after so long of a tick the solve is stopped, and its plan taken as it is, with "
        "ranges and slew kept; unset: half of sample_time. A simulation is bounded by iterations alone [s]",
    )
    max_missed: Annotated[int, Field(ge=1, le=100_000)] = Field(
        5,
        description="ticks in a row whose solve is cut off by time_limit or ends after it, from which on the robot "
        "brakes, until a solve is in time again [-]",
    )
    osqp: Osqp = Osqp()

    @property
    def backend(self) -> str:
        """Solver for ticks in which the core's own methods are disabled or prove no solution."""
        return "daqp" if self.method == "auto" else self.method
