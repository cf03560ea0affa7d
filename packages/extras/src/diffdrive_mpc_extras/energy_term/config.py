"""The part of the configuration that says what turns cost; see docs/energy.md."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from diffdrive_mpc.mpc.config.group import Group, NotNegative


class Energy(Group):
    """What turns cost this robot on its floor, and what the plan makes of it."""

    weight: NotNegative = Field(
        0.0, description="electrical power that turning takes, summed over the steps of the horizon; 0: no matter [1/W]"
    )
    turn_costs: str = Field("", description="name of shipped turn costs or path of a file, as torque writes it [-]")
    use_min_radius: bool = Field(
        False,
        description="take limits.min_commanded_radius from the turn costs, at the speed of their table, where it is "
        "not given [-]",
    )

    @model_validator(mode="after")
    def _has_costs(self) -> Self:
        if (self.weight or self.use_min_radius) and not self.turn_costs:
            raise ValueError("turn_costs: say which; shipped are fsu_bot-default and others, torque writes yours")
        return self
