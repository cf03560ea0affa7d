"""The conditions of the study: robots, floors, sensors and what happens, by name; shipped in `conditions.yaml`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from diffdrive_mpc.bench.case import NO_MODEL, NO_SCENARIO, Case
from diffdrive_mpc.bench.peers import LAWS, PEERS
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.robot import NotNegative


class Condition(StrictModel):
    """Where a controller is tried, and what it is told of it; what is left out is as usual."""

    plant: str = Field("mujoco", description="as --plant")
    surface: str = Field("default", description="as --surface")
    sensors: str = Field("default", description="as --sensors")
    scenario: str = Field(NO_SCENARIO, description="as --scenario")
    settings: dict[str, bool | int | float | str] = Field(
        default_factory=dict, description="configuration values of the robot, by dotted key"
    )

    def case(self, controller: str, model: str, trajectory: str, seed: int) -> Case:
        """One run under this condition; a peer has no model, and settings where it acts on the same estimate."""
        peer = controller in PEERS
        return Case(
            controller=controller,
            model=NO_MODEL if peer else model,
            trajectory=trajectory,
            plant=self.plant,
            surface=self.surface,
            sensors=self.sensors,
            scenario=self.scenario,
            seed=seed,
            overrides=tuple(self.settings.items()) if controller in LAWS or not peer else (),
        )


class Conditions(StrictModel):
    """All conditions of a file."""

    settled: NotNegative = Field(description="time from which on the largest lateral error counts [s]")
    quick: tuple[str, ...] = Field((), description="conditions of a quick study; without any, all of them")
    conditions: Annotated[dict[str, Condition], Field(min_length=1)]

    @model_validator(mode="after")
    def _known(self) -> Conditions:
        self.chosen(self.quick or None, "quick")
        return self

    def chosen(self, names: Sequence[str] | None, where: str = "--only") -> dict[str, Condition]:
        """Conditions by name, all without names; raises ConfigError where there is none of a name."""
        unknown = [name for name in names or () if name not in self.conditions]
        if unknown:
            raise ConfigError(f"{where}: unknown condition '{unknown[0]}'; known: {', '.join(self.conditions)}")
        return {name: self.conditions[name] for name in names or self.conditions}


def load_conditions(file: Path | None = None) -> Conditions:
    """Read a file of conditions, by default the shipped one; raises ConfigError when it has a mistake."""
    return load_checked(Conditions, file or Path(__file__).with_name("conditions.yaml"))
