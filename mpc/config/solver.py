"""Schema of the solver settings."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from diffdrive_mpc.mpc.config.group import Group


class Osqp(Group):
    """Settings of OSQP, with its names, for `solver.method` osqp."""

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
        description="auto: the unconstrained minimiser if it is within the limits, else the active set, and DAQP if "
        "its solution is not proven optimal; osqp: OSQP at every tick; daqp: DAQP at every tick [-]",
    )
    active_set_iterations: Annotated[int, Field(ge=0, le=5000)] = Field(
        500,
        description="maximum number of systems that the active set solves at a tick; its plan is then used as it is, "
        "within ranges and slew; 0: use DAQP at once [-]",
    )
    max_iterations: Annotated[int, Field(ge=10, le=100_000)] = Field(
        2000, description="limit of the iterations of one solve of DAQP [-]"
    )
    tolerance: Annotated[float, Field(ge=1e-9, le=1e-2)] = Field(
        1e-5,
        description="tolerance of DAQP on the limits, in units of rows normalised by the cost; all solvers treat a "
        "limit as satisfied within a tenth of it [-]",
    )
    time_limit: Annotated[float, Field(gt=0)] | None = Field(
        None,
        description="for the node: time of a tick after which the solve is stopped and its plan used as it is, within "
        "ranges and slew; unset: half of sample_time. A simulation is limited by iterations only [s]",
    )
    max_missed: Annotated[int, Field(ge=1, le=100_000)] = Field(
        5,
        description="successive ticks whose solve is stopped by time_limit or ends after it, after which the robot "
        "brakes until a solve is in time again [-]",
    )
    osqp: Osqp = Osqp()

    @property
    def backend(self) -> str:
        """Solver for ticks in which the core's own methods are disabled or prove no solution."""
        return "daqp" if self.method == "auto" else self.method
