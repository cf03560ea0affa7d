"""Definition of a run of a campaign: a case, and values that replace values of its files."""

from __future__ import annotations

import difflib
import hashlib
import json
import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import diffdrive_mpc_extras
from diffdrive_mpc import models, mpc, sim
from diffdrive_mpc.bench import case, controllers, peers, run_row
from diffdrive_mpc.bench.case import DIMENSIONS, NO_MODEL, Case, Overrides, label
from diffdrive_mpc.bench.controllers import CONTROLLERS
from diffdrive_mpc.bench.machine import package_version
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.compiled.cache import content_digest
from diffdrive_mpc.models.suggestions import format_unknown_name
from diffdrive_mpc.models.trust import is_trusted
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.sim.plants.simulated_robot import DEFAULT, digital_twin, load_simulated_robot
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from diffdrive_mpc_extras.campaign.draws import Value

GROUPS = ("config", "robot", "surface", "sensors")
"""Groups of factors that replace a value of a file, such as the key `robot.twin.link.dead_time` of the robot file."""
FACTORS_OF_A_CASE = (*(dimension.name for dimension in DIMENSIONS), "config", "top_speed", "scaled", "late")
"""Factors that are fields of the case."""
_TYPES: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(FACTORS_OF_A_CASE, (str,)),
    "seed": (int,),
    "late": (int,),
    "scaled": (bool,),
    "top_speed": (int, float),
}


@dataclass(frozen=True)
class Definition:
    """Definition of one run, without the version of the product.

    Attributes
    ----------
    case
        Controller, model, path, plant and so on; `case.overrides` replace values of the controller configuration.
    robot, surface, sensors
        Values by dotted key that replace values of the files named in the case.
    """

    case: Case
    robot: Overrides = ()
    surface: Overrides = ()
    sensors: Overrides = ()

    @classmethod
    def from_factors(cls, factors: Mapping[str, Value], where: str = "run") -> Definition:
        """Build a run from values by factor name; raises ConfigError for an unknown factor or a wrong type."""
        fields_of_case: dict[str, Any] = {}
        groups: dict[str, dict[str, object]] = {name: {} for name in GROUPS}
        for name, value in factors.items():
            check_factor(name, where)
            group, dot, key = name.partition(".")
            if dot:
                groups[group][key] = value
                continue
            kinds = _TYPES[name]
            if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
                raise ConfigError(f"{where}: {name}: {value!r} has the wrong type; give {_type_name(kinds)}")
            fields_of_case[name] = value
        peer = fields_of_case.get("controller") in PEERS
        if peer and groups["config"]:
            # A peer has no configuration, so these factors apply only to the predictive controller.
            groups["config"] = {}
        if peer:
            fields_of_case |= {"model": NO_MODEL, "config": None}
        elif "config" in fields_of_case and "model" not in fields_of_case:
            fields_of_case["model"] = _model_of(fields_of_case["config"])
        case = Case(**fields_of_case, overrides=_sorted(groups["config"]))
        if case.controller not in CONTROLLERS:
            raise ConfigError(f"{where}: unknown controller {format_unknown_name(case.controller, CONTROLLERS)}")
        return cls(case, *(_sorted(groups[name]) for name in GROUPS[1:]))

    @property
    def factors(self) -> dict[str, Value | None]:
        """All values by factor name, including defaults; inverse of `from_factors`."""
        case_values = {name: getattr(self.case, name) for name in FACTORS_OF_A_CASE}
        grouped = {f"{group}.{key}": value for group in GROUPS for key, value in self._group(group)}
        return case_values | grouped

    @property
    def columns(self) -> dict[str, Value | None]:
        """Values of `factors` for tables; paths are reduced to their stem, which does not depend on the machine."""
        return {name: label(value) if isinstance(value, str) else value for name, value in self.factors.items()}

    def with_factors(self, changes: Mapping[str, Value]) -> Definition:
        """Return the run with changed values by factor name; raises ConfigError as `from_factors`."""
        known = {name: value for name, value in self.factors.items() if value is not None}
        return Definition.from_factors(known | dict(changes))

    def with_seed(self, seed: int) -> Definition:
        """Return the same run with another seed."""
        return replace(self, case=replace(self.case, seed=seed))

    def _group(self, name: str) -> Overrides:
        return self.case.overrides if name == "config" else getattr(self, name)


def check_factor(name: str, where: str) -> None:
    """Raise ConfigError if `name` is not a factor."""
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


def _type_name(kinds: tuple[type, ...]) -> str:
    return {bool: "true or false", int: "a whole number", float: "a number", str: "a name"}[kinds[-1]]


# Values of plant, surface and sensors in the files of a run, for factors that vary around them.


def file_value(key: str, factors: Mapping[str, object]) -> float:
    """Return the number at a dotted key of robot, surface or sensors in the files named by `factors`.

    Raises ConfigError if there is no number at the key.
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
        raise ConfigError(f"spread.{key}: the plant '{factors.get('plant')}' has no robot file; remove the key")
    for part in rest.split("."):
        data = data.get(part) if isinstance(data, Mapping) else None
    if isinstance(data, bool) or not isinstance(data, (int, float)):
        raise ConfigError(f"spread.{key}: this key has no numeric value")
    return float(data)


LIBRARIES = ("numpy", "scipy", "casadi", "osqp", "daqp", "mujoco", "control")
"""Packages whose version can change the result of a run."""
_SUFFIXES = frozenset({".py", ".c", ".h", ".yaml", ".csv", ".npz", ".xml"})


@lru_cache(maxsize=1)
def product_hash() -> str:
    """Hash the code and the parameter files that affect a run; report code is excluded.

    The hash depends on the content and not on the revision: modified checkouts have different hashes, and a wheel has
    the hash of its checkout.
    """
    folders = [_folder(package) for package in (models, mpc, sim, peers, diffdrive_mpc_extras)]
    files = [Path(str(module.__file__)) for module in (case, controllers, run_row)]
    sources = [(path.relative_to(folder.parent), path) for folder in folders for path in folder.rglob("*")]
    named = {str(name): path for name, path in sources if path.suffix in _SUFFIXES and path.is_file()}
    named |= {path.name: path for path in files}
    total = hashlib.sha256()
    for name in sorted(named):
        total.update(f"{name}\0{_digest(named[name])}\n".encode())
    return total.hexdigest()


@lru_cache(maxsize=1)
def environment() -> dict[str, str]:
    """Describe the environment of a run: product, numerical libraries, Python, processor architecture."""
    libraries = {name: package_version(name) for name in LIBRARIES}
    python = ".".join(platform.python_version_tuple()[:2])
    return {"product": product_hash(), "python": python, "machine": platform.machine(), **libraries}


def identify(definition: Definition) -> dict[str, object]:
    """Collect the data of a run's hash; files are identified by their content."""
    factors = {name: _by_content(name, value) for name, value in definition.factors.items()}
    return {"run": factors, "environment": environment()}


def key_of(definition: Definition) -> str:
    """Compute the hash (64 hexadecimal digits) under which a run is stored."""
    text = json.dumps(identify(definition), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _by_content(name: str, value: object) -> object:
    """Replace a path by the hash of the file and of all files that it references."""
    if not isinstance(value, str) or name in ("controller", "timing", "seed"):
        return value
    kind, colon, rest = value.rpartition(":")
    path, plus, suffix = rest, "", ""
    if not _is_file(path) and "+" in path:
        path, plus, suffix = rest.rpartition("+")
    if not _is_file(path):
        return value
    contents = {_digest(file) for file in _referenced_files(Path(path).resolve(), set())}
    return f"{kind}{colon}files {' '.join(sorted(contents))}{plus}{suffix}"


def _referenced_files(path: Path, visited: set[Path]) -> Iterator[Path]:
    """Yield a file, its weights, and the files that its text references."""
    if path in visited:
        return
    visited.add(path)
    yield path
    weights = path.with_suffix(".npz")
    if weights != path and weights.is_file():
        yield weights
    if path.suffix in (".yaml", ".yml"):
        for text in _texts(read_yaml(path)):
            if _is_file(path.parent / text):
                yield from _referenced_files((path.parent / text).resolve(), visited)


def _texts(data: object) -> Iterator[str]:
    if isinstance(data, str):
        yield data
    elif isinstance(data, (Mapping, list)):
        for inner in data.values() if isinstance(data, Mapping) else data:
            yield from _texts(inner)


def _is_file(path: str | Path) -> bool:
    try:
        return str(path) != "" and is_trusted(path) and Path(path).is_file()
    except (OSError, ValueError):  # a long text is not a file name
        return False


def _digest(path: Path) -> str:
    state = path.stat()
    return _digest_of(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=4096)
def _digest_of(path: Path, _changed: int, _size: int) -> str:
    return content_digest(path)


def _folder(package: object) -> Path:
    return Path(str(package.__file__)).parent  # type: ignore[attr-defined]
