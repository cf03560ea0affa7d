"""The schema of how the problem is solved."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from diffdrive_mpc.mpc.config.group import Group


class Solver(Group):
    """How the problem is solved."""

    compiled: Literal["auto", "never", "always"] = Field(
        "auto",
        description="run estimator and problem in C, compiled at first use: auto falls back to Python where there is "
        "no C compiler, always refuses to start without one [-]",
    )
    formulation: Literal["condensed", "sparse"] = Field(
        "condensed",
        description="condensed: a small dense problem in the commands alone; sparse: states and poses are variables "
        "too. Both have the same solution [-]",
    )
    backend: Literal["osqp", "daqp"] = Field(
        "osqp",
        description="osqp: operator splitting, for either formulation; daqp: dual active set, exact and fast, for the "
        "condensed one [-]",
    )
    max_iterations: Annotated[int, Field(ge=10, le=100_000)] = Field(
        2000, description="limit of the iterations of one solve [-]"
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
        description="limit of the time of one solve, for robots; it breaks determinism in simulation [s]",
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.formulation == "sparse" and self.backend != "osqp":
            raise ValueError(
                f"backend {self.backend} solves the condensed formulation only; set backend: osqp or "
                "formulation: condensed"
            )
        return self
