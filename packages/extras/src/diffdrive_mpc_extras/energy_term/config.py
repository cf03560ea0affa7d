"""The part of the configuration that says what turns cost; see packages/extras/docs/energy.md."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from diffdrive_mpc.models.named_file import is_file
from diffdrive_mpc.mpc.config.group import FeatureGroup, NotNegative
from diffdrive_mpc.mpc.config.schema import ControllerConfig


class Energy(FeatureGroup):
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

    @property
    def is_enabled(self) -> bool:
        """True if the configuration weighs turns or takes the radius from their costs."""
        return bool(self.weight) or self.use_min_radius

    def relative_to(self, folder: Path) -> Energy:
        """Return the group with turn costs of `folder`, if a file there has their name."""
        path = folder / self.turn_costs
        if not self.turn_costs or Path(self.turn_costs).is_absolute() or not is_file(path):
            return self
        return self.model_copy(update={"turn_costs": str(path)})

    def check_files(self) -> None:
        """Raise UntrustedFileError or ConfigError if the turn costs cannot be read."""
        from diffdrive_mpc_extras.turn_costs import load_turn_costs  # noqa: PLC0415 - loads CasADi

        if self.turn_costs:
            load_turn_costs(self.turn_costs)


def energy_of(config: ControllerConfig) -> Energy:
    """Return the group of a configuration, with its defaults if the configuration does not name it."""
    return config.feature_group("energy", Energy)
