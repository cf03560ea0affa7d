"""The schema of how the problem is solved."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from diffdrive_mpc.mpc.config.group import Group


class Solver(Group):
    """How the problem is solved."""

    strategy: Literal["auto", "backend"] = Field(
        "auto",
        description="auto: the minimiser without limits where it keeps them, then the active set, and the backend "
        "where that is not proven; backend: the backend at every tick, to measure it under its own name [-]",
    )
    backend: Literal["osqp", "daqp"] = Field(
        "daqp", description="osqp: operator splitting; daqp: dual active set, exact [-]"
    )
    active_set_iterations: Annotated[int, Field(ge=0, le=5000)] = Field(
        500,
        description="systems that the active set may solve at a tick; then its plan is taken as it is, with ranges and "
        "slew kept; 0: ask the backend at once [-]",
    )
    max_iterations: Annotated[int, Field(ge=10, le=100_000)] = Field(
        2000, description="limit of the iterations of one solve of the backend [-]"
    )
    tolerance: Annotated[float, Field(ge=1e-9, le=1e-2)] = Field(
        1e-5,
        description="osqp: absolute and relative tolerance on the residuals; daqp: on the limits, in units of rows "
        "normalised by the cost [-]",
    )
    check_every: Annotated[int, Field(ge=1, le=1000)] = Field(
        10, description="osqp: iterations between two checks of the residuals [-]"
    )
    time_limit: Annotated[float, Field(gt=0)] | None = Field(
        None,
        description="the node's: after so long of a tick the solve is stopped, and its plan taken as it is, with "
        "ranges and slew kept; unset: half of sample_time. A simulation is bounded by iterations alone [s]",
    )
