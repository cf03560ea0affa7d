"""What defines a run of a campaign: a case, and values that replace those of the files it names."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

from diffdrive_mpc.bench.case import DIMENSIONS, NO_MODEL, Case, Overrides, label
from diffdrive_mpc.bench.controllers import CONTROLLERS
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.sim.plants.simulated_robot import DEFAULT, digital_twin, load_simulated_robot
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from diffdrive_mpc_extras.campaign.draws import Value

GROUPS = ("config", "robot", "surface", "sensors")
"""Files whose single values a factor may replace: `robot.twin.link.dead_time` is a key of the robot's file."""
FACTORS_OF_A_CASE = (*(dimension.name for dimension in DIMENSIONS), "config", "top_speed", "scaled", "late")
"""Factors that are no key of a file."""
_TYPES: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(FACTORS_OF_A_CASE, (str,)),
    "seed": (int,),
    "late": (int,),
    "scaled": (bool,),
    "top_speed": (int, float),
}


@dataclass(frozen=True)
class Definition:
    """Everything that fixes one run, beside the product itself.

    Attributes
    ----------
    case
        Controller, model, path, plant, ...; `case.overrides` replace values of the controller's configuration.
    robot, surface, sensors
        Values by dotted key that replace those of the files that the case names.
    """

    case: Case
    robot: Overrides = ()
    surface: Overrides = ()
    sensors: Overrides = ()

    @classmethod
    def of(cls, factors: Mapping[str, Value], where: str = "run") -> Definition:
        """The run with these values by name of their factors; raises ConfigError where there is no such factor."""
        own: dict[str, Any] = {}
        groups: dict[str, dict[str, object]] = {name: {} for name in GROUPS}
        for name, value in factors.items():
            check_factor(name, where)
            group, dot, key = name.partition(".")
            if dot:
                groups[group][key] = value
                continue
            kinds = _TYPES[name]
            if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
                raise ConfigError(f"{where}: {name}: {value!r} is of another kind; give {_said(kinds)}")
            own[name] = value
        peer = own.get("controller") in PEERS
        if peer and groups["config"]:
            # A peer has no configuration: what varies there varies for the predictive controller only.
            groups["config"] = {}
        if peer:
            own |= {"model": NO_MODEL, "config": None}
        elif "config" in own and "model" not in own:
            own["model"] = _model_of(own["config"])
        case = Case(**own, overrides=_sorted(groups["config"]))
        if case.controller not in CONTROLLERS:
            raise ConfigError(f"{where}: unknown controller '{case.controller}'; known: {', '.join(CONTROLLERS)}")
        return cls(case, *(_sorted(groups[name]) for name in GROUPS[1:]))

    @property
    def factors(self) -> dict[str, Value | None]:
        """All of it by name of the factors; what has its default, too. `of` gives it back."""
        of_case = {of.name: getattr(self.case, of.name) for of in fields(Case) if of.name != "overrides"}
        grouped = {f"{group}.{key}": value for group in GROUPS for key, value in self._group(group)}
        return of_case | grouped

    @property
    def columns(self) -> dict[str, Value | None]:
        """`factors` for tables: of a path only the stem, which says nothing of the machine."""
        return {name: label(value) if isinstance(value, str) else value for name, value in self.factors.items()}

    def changed(self, changes: Mapping[str, Value]) -> Definition:
        """The same with other values by name of their factors; raises ConfigError as `of`."""
        known = {name: value for name, value in self.factors.items() if value is not None}
        return Definition.of(known | dict(changes))

    def with_seed(self, seed: int) -> Definition:
        """The same run with another seed."""
        return replace(self, case=replace(self.case, seed=seed))

    def _group(self, name: str) -> Overrides:
        return self.case.overrides if name == "config" else getattr(self, name)


def check_factor(name: str, where: str) -> None:
    """Raise ConfigError if there is no factor `name`."""
    group, dot, key = name.partition(".")
    if name in FACTORS_OF_A_CASE or (dot and key and group in GROUPS):
        return
    known = (*FACTORS_OF_A_CASE, *(f"{group}.KEY" for group in GROUPS))
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    hint = f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(known)}"
    raise ConfigError(f"{where}: unknown factor '{name}'{hint}")


@lru_cache
def _model_of(config: str) -> str:
    return load_config(config).model


def _sorted(values: Mapping[str, object]) -> Overrides:
    return tuple(sorted(values.items()))


def _said(kinds: tuple[type, ...]) -> str:
    return {bool: "true or false", int: "a whole number", float: "a number", str: "a name"}[kinds[-1]]


# What plant, floor and sensors of a run say, for factors that are spread about it.


def stated(key: str, factors: Mapping[str, object]) -> float:
    """The number behind a dotted key of robot, floor or sensors, as the files that `factors` name have it.

    Raises ConfigError if there is none.
    """
    group, _, rest = key.partition(".")
    kind, _, name = str(factors.get("plant", "mujoco")).partition(":")
    robot = load_simulated_robot(name).model_dump() if kind == "mujoco" and name else digital_twin()
    surface, sensors = str(factors.get("surface", DEFAULT)), str(factors.get("sensors", DEFAULT))
    data: object = robot
    if group == "surface":
        floor = load_surface(surface).model_dump()
        if surface == DEFAULT and robot.get("friction"):
            floor["friction"] = robot["friction"]
        data = floor
    elif group == "sensors":
        data = robot["sensors"] if sensors == DEFAULT else load_sensor_set(sensors).model_dump()
    elif kind != "mujoco":
        raise ConfigError(f"spread.{key}: the plant '{factors.get('plant')}' has no robot file; leave it out")
    for part in rest.split("."):
        data = data.get(part) if isinstance(data, Mapping) else None
    if isinstance(data, bool) or not isinstance(data, (int, float)):
        raise ConfigError(f"spread.{key}: there is no number there that could be spread")
    return float(data)
