"""One case of an experiment: which controller drives which plant along which trajectory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from diffdrive_mpc.bench.controllers import PEERS, controller_config, make_controller
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import Reference, TrackingController
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.sim import Plant, Run, make_plant, simulate

Overrides = tuple[tuple[str, object], ...]
"""Configuration values by dotted key."""

NO_SCENARIO = "none"
"""The scenario in which nothing happens."""


@dataclass(frozen=True)
class Case:
    """Everything that fixes one run bit for bit.

    Attributes
    ----------
    controller
        "mpc" or the name of a peer.
    model
        Velocity model of the controller: a name or a path; "none" for a peer without one.
    trajectory, plant, surface, sensors
        Names or paths, as `load_trajectory` and `make_plant` take them.
    seed
        Seed of the plant's noise.
    config
        Controller configuration file; None for the shipped one of the model.
    overrides
        Values that replace those of the configuration.
    scenario
        What happens to the robot: a name or path, as `make_plant` takes it.
    """

    controller: str
    model: str
    trajectory: str
    plant: str
    surface: str
    sensors: str
    seed: int
    config: str | None = None
    overrides: Overrides = ()
    scenario: str = NO_SCENARIO

    @property
    def horizon(self) -> int | None:
        """Steps that the controller looks ahead; None for one that does not."""
        if self.controller in PEERS:
            return None
        return controller_config(self.model, self.config, self.overrides).horizon

    @property
    def labels(self) -> dict[str, str]:
        """Names for tables and files; of a path only the stem, which says nothing of the machine."""
        names = ("controller", "model", "trajectory", "plant", "surface", "sensors", "scenario")
        return {name: label(getattr(self, name)) for name in names}

    def with_override(self, key: str, value: object) -> Case:
        """The same case with one configuration value replaced."""
        kept = tuple(pair for pair in self.overrides if pair[0] != key)
        return replace(self, overrides=(*kept, (key, value)))


def label(name: str) -> str:
    """A name as it is, a path without folders and ending; "model:PATH+SECONDS" keeps what stands around the path."""
    kind, separator, rest = name.rpartition(":")
    base = Path(rest).name
    for ending in (".yaml", ".yml", ".csv"):
        base = base.replace(ending, "")
    return kind + separator + base


def build(case: Case) -> tuple[TrackingController, Plant, Reference]:
    """Make the controller, plant and reference of a case.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError
        If a name is unknown, a file has a mistake, or controller and plant have different sample times.
    """
    controller = make_controller(case.controller, case.model, case.config, case.overrides)
    plant = make_plant(case.plant, case.surface, case.sensors, case.seed, scenario=case.scenario)
    if case.controller not in PEERS:
        asked = controller_config(case.model, case.config, case.overrides).sample_time
        if asked != plant.sample_time:
            raise ConfigError(
                f"sample_time {asked} s: the plant '{case.plant}' takes a command every {plant.sample_time} s; "
                f"set sample_time to that"
            )
    return controller, plant, load_trajectory(case.trajectory)


def run_case(case: Case) -> Run:
    """Run one closed loop; raises as `build` does."""
    return simulate(*build(case))
