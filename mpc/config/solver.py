"""Schema of the solver settings."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from diffdrive_mpc.mpc.config.group import Group


class Osqp(Group):
    """Settings of OSQP under the names of OSQP, used if `solver.method` is osqp."""

    eps_abs: Annotated[float, Field(ge=1e-9, le=1e-2)] = Field(
        1e-6, description="absolute tolerance on the residuals of OSQP [-]"
    )
    eps_rel: Annotated[float, Field(ge=1e-9, le=1e-2)] = Field(
        1e-6, description="relative tolerance on the residuals of OSQP [-]"
    )
    max_iter: Annotated[int, Field(ge=10, le=100_000)] = Field(
        4000, description="maximum number of iterations per solve of OSQP [-]"
    )
    check_termination: Annotated[int, Field(ge=1, le=1000)] = Field(
        10, description="number of iterations between two checks of the residuals of OSQP [-]"
    )


class Solver(Group):
    """Solver of the quadratic program."""

    method: Literal["auto", "osqp", "daqp"] = Field(
        "auto",
        description="auto: the unconstrained minimiser if it satisfies the limits, else the active set, and DAQP if "
        "optimality is not proven; osqp: OSQP at every tick; daqp: DAQP at every tick [-]",
    )
    active_set_iterations: Annotated[int, Field(ge=0, le=5000)] = Field(
        500,
        description="maximum number of systems that the active set solves per tick; at the maximum, the current plan "
        "within ranges and slew is used; 0: use DAQP at once [-]",
    )
    max_iterations: Annotated[int, Field(ge=10, le=100_000)] = Field(
        2000, description="maximum number of iterations per solve of DAQP [-]"
    )
    tolerance: Annotated[float, Field(ge=1e-9, le=1e-2)] = Field(
        1e-5,
        description="tolerance of DAQP on the limits, in units of rows normalised by the cost; all solvers treat a "
        "limit as satisfied within a tenth of this tolerance [-]",
    )
    time_limit: Annotated[float, Field(gt=0)] | None = Field(
        None,
        description="for the node: time per tick after which the solve stops and the current plan within ranges and "
        "slew is used; unset: half of sample_time; simulations are limited by iterations only [s]",
    )
    max_missed: Annotated[int, Field(ge=1, le=100_000)] = Field(
        5,
        description="number of consecutive ticks that exceed time_limit after which the robot brakes until a solve is "
        "in time again [-]",
    )
    osqp: Osqp = Osqp()

    @property
    def backend(self) -> str:
        """Name of the solver for ticks in which the methods of the core are disabled or do not prove optimality."""
        return "daqp" if self.method == "auto" else self.method
