"""Definition of a run by one value for each dimension.

Dimensions are declared only as fields of `Case`. Options, plan, names in tables, figures and JSON, and the introduction
of a report are derived from these fields; docs/recipes.md describes how to add a dimension.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge

from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.sim.plants.names import BUILT_IN, split_plant

Overrides = tuple[tuple[str, object], ...]
"""Configuration values by dotted key."""


def describe_setting(setting: tuple[str, object]) -> str:
    """Format an override for names and notes."""
    key, value = setting
    return str(value).upper() if key == "solver.method" else f"{key}={value}"


NO_SCENARIO, NO_MODEL, AS_FILED = "none", "none", "file"
"""Scenario without disturbances; placeholder for the model of a peer; timing of the trajectory file."""
MAX_SEEDS = 10_000
"""Maximum number of seeds of a case; more runs would take days, and their list could fill the memory."""
MAX_CASES = 100_000
"""Maximum number of cases of a study; this number takes several days on two cores and a gigabyte of results."""
COMPARED = (
    *((peer, NO_MODEL) for peer in ("lqr+slip", "kanayama+slip", "pursuit+slip")),
    *(("mpc", model) for model in ("kinematic", "two_delays", "mbm", "sm", "ssm")),
)
"""Controllers with their models that `bench` compares by default."""
OSQP_MODEL, BY_OSQP = "ssm", (("solver.method", "osqp"),)
"""Model for which `bench` by default also compares OSQP at every tick, and the overrides that select OSQP."""
HORIZONS = (7, 10, 20, 30, 50)
"""Horizons that `bench` sweeps for each model with the first seed [steps]."""


def split_names(text: str, option: str) -> tuple[str, ...]:
    """Split `a,b,c` into names; raise ValueError if a name is empty or given twice."""
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise ValueError(f"{option} '{text}': give one name, or several names separated by commas")
    if len(set(names)) < len(names):
        previous: set[str] = set()
        repeated = next(name for name in names if name in previous or previous.add(name))  # type: ignore[func-returns-value]
        raise ValueError(f"{option} '{text}': '{repeated}' is given twice")
    return names


def check_different(where: str, values: Sequence[object]) -> None:
    """Raise ConfigError if there are no values, or if a value is given twice."""
    from diffdrive_mpc.models.checked_yaml import ConfigError  # noqa: PLC0415 - --help does not need it

    if not values:
        raise ConfigError(f"{where} has no value; state at least one")
    if repeated := [value for index, value in enumerate(values) if value in values[:index]]:
        raise ConfigError(f"{where}: {str(repeated[0])!r} is given twice; state different values")


def check_count(count: int, limit: int = MAX_CASES) -> None:
    """Raise ValueError if a study has more runs than the limit, before the cases are listed."""
    if count > limit:
        raise ValueError(
            f"{count:,} runs are requested, the limit is {limit:,}; give fewer values or seeds, or split the study"
        )


def split_numbers(text: str, option: str, *, minimum: int, maximum: int | None = None) -> tuple[int, ...]:
    """Split `1,2,3` into whole numbers from `minimum` to `maximum`; raise ValueError for other text."""
    try:
        numbers = tuple(int(number) for number in split_names(text.rstrip(","), option))
    except ValueError as error:
        raise ValueError(f"{option} '{text}': give different whole numbers, separated by commas") from error
    if min(numbers) < minimum:
        raise ValueError(f"{option} '{text}': each number must be at least {minimum}")
    if maximum is not None and max(numbers) > maximum:
        raise ValueError(f"{option} '{text}': each number must be at most {maximum}")
    return numbers


def parse_seeds(text: str, option: str = "--seeds") -> tuple[int, ...]:
    """Parse seeds: `5` for the seeds 0 to 4, or a list with commas such as `7,` or `3,4`; may raise ValueError."""
    numbers = split_numbers(text, option, minimum=0)
    if "," in text:
        return numbers
    if numbers[0] == 0:
        raise ValueError(f"{option} 0: give the number of seeds (at least 1), or a list such as 0,1,2")
    if numbers[0] > MAX_SEEDS:
        raise ValueError(f"{option} {text}: give at most {MAX_SEEDS} seeds; for the single seed {text} write {text},")
    return tuple(range(numbers[0]))


@dataclass(frozen=True)
class Dimension:
    """Dimension of a comparison.

    Attributes
    ----------
    plural
        Plural of the name, which is the key of the requested values in settings and in the `meta` part of a report.
    default
        Value if no value is requested.
    help
        Help text of the option.
    compared
        Values that `bench` compares by default; only `default` if empty.
    list_option, list_help
        Option for several values, and its help text; by default equal to `option` and `help`.
    kind
        Type of a value, with its range.
    read
        Function that parses the text of the list option; it raises ValueError for invalid text.
    silent
        True if rows and introduction omit the dimension when only its default was requested.
    name
        Name of the field of `Case`, which is also the column name in tables and the key of a run in JSON.
    """

    plural: str
    default: Any
    help: str
    compared: tuple[Any, ...] = ()
    list_option: str = ""
    list_help: str = ""
    kind: Any = str
    read: Callable[[str, str], tuple[Any, ...]] = split_names
    silent: bool = False
    name: str = ""

    @property
    def option(self) -> str:
        """Option for a single value."""
        return f"--{self.name.replace('_', '-')}"

    @property
    def place(self) -> bool:
        """True for a dimension of the conditions of a run, which is part of a controller's name if it varies."""
        return self.name not in ("controller", "model", "trajectory", "seed")


def _dimension(plural: str, default: object, text: str, **more: Any) -> Any:  # noqa: ANN401 - a field of any type
    return field(default=default, metadata={"dimension": Dimension(plural, default, text, **more)})


@dataclass(frozen=True)
class Case:
    """Complete definition of a run; equal cases result in bit-identical runs.

    The following fields are not dimensions. `config` is the configuration file of the controller, None for the built-in
    configuration of the model. `overrides` replace configuration values. `top_speed` scales the trajectory's segments
    to this maximum speed [m/s]. `scaled` fits the segments to size and limits of the robot of the configuration. `late`
    is the dead time of the plant minus that of the controller [ticks]: a positive value is added to the dead time of
    the plant; for a negative value, `overrides` configure a longer dead time. `gains` replace the gains of a peer.
    """

    controller: str = _dimension(
        "controllers",
        "mpc",
        f"mpc or a peer: {', '.join(PEERS)}.",
        compared=tuple(dict.fromkeys(controller for controller, _ in COMPARED)),
    )
    model: str = _dimension(
        "models",
        "ssm",
        "Velocity model: mbm, sm, ssm, two_delays, kinematic, or the path of a file.",
        compared=tuple(model for _, model in COMPARED if model != NO_MODEL),
        list_option="--models",
    )
    trajectory: str = _dimension(
        "trajectories",
        "circle",
        "circle, square, s, cane, figure8, ..., spline-SEED, or the path of a file.",
        compared=("circle", "square", "s", "cane"),
        list_option="--trajectories",
    )
    timing: str = _dimension(
        "timings",
        AS_FILED,
        f"Timing of the trajectory: stop, commanded, smooth, or {AS_FILED} for that of the trajectory file.",
        silent=True,
    )
    plant: str = _dimension(
        "plants", "mujoco", "mujoco, mujoco:ROBOT, model:NAME, model:NAME+DEAD_TIME, or world:NAME[@PLANT]."
    )
    surface: str = _dimension("surfaces", "default", "Surface under the mujoco plant, or slip of a model: plant.")
    sensors: str = _dimension("sensors", "default", "Sensor set.")
    scenario: str = _dimension(
        "scenarios", NO_SCENARIO, "Disturbance scenario: none, push, ..., or the path of a file.", silent=True
    )
    seed: int = _dimension(
        "seeds",
        0,
        "Seed of the noise; the same seed gives the same run.",
        compared=(0, 1, 2, 3, 4),
        list_option="--seeds",
        list_help="Number of seeds, or a list of seeds.",
        kind=Annotated[int, Ge(0)],
        read=parse_seeds,
    )
    config: str | None = None
    overrides: Overrides = ()
    top_speed: float | None = None
    scaled: bool = False
    late: int = 0
    gains: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        """Set the default trajectory to that of the plant if the plant defines a path."""
        if self.trajectory == str(Case.trajectory) and split_plant(self.plant) is not None:
            object.__setattr__(self, "trajectory", self.plant)

    @property
    def horizon(self) -> int | None:
        """Horizon of the predictive controller [steps]; None for a peer."""
        from diffdrive_mpc.bench.controllers import controller_config  # noqa: PLC0415 - --help does not need it

        ours = self.controller not in PEERS
        return controller_config(self.model, self.config, self.overrides).horizon if ours else None

    @property
    def labels(self) -> dict[str, str]:
        """Value of each dimension for tables and files; paths are reduced to their stems."""
        return {dimension.name: label(getattr(self, dimension.name)) for dimension in DIMENSIONS}

    def as_row(self, leave_out: Container[str] = ()) -> dict[str, object]:
        """Return the values of the dimensions for JSON, without the dimensions in `leave_out`."""
        values = {
            dimension.name: getattr(self, dimension.name) for dimension in DIMENSIONS if dimension.name not in leave_out
        }
        return {name: label(value) if isinstance(value, str) else value for name, value in values.items()}

    def with_override(self, key: str, value: object) -> Case:
        """Return the case with a replaced configuration value."""
        remaining = tuple(pair for pair in self.overrides if pair[0] != key)
        return replace(self, overrides=(*remaining, (key, value)))


DIMENSIONS: tuple[Dimension, ...] = tuple(
    replace(
        entry,
        name=member.name,
        compared=entry.compared or (entry.default,),
        list_option=entry.list_option or replace(entry, name=member.name).option,
        list_help=entry.list_help or entry.help,
    )
    for member in fields(Case)
    if (entry := member.metadata.get("dimension"))
)
"""Dimensions in the order of the fields of `Case`."""


def combinations(**values: Iterable[object]) -> list[Case]:
    """Return a case for each combination of the values of fields; the last field varies fastest.

    Other fields have their default values. Raise ValueError if there are more than `MAX_CASES` combinations.
    """
    options = [tuple(field_values) for field_values in values.values()]
    check_count(math.prod(map(len, options)))
    entries = [dict(zip(values, combination, strict=True)) for combination in itertools.product(*options)]
    return [Case(**entry) for entry in entries]  # type: ignore[arg-type]


_WRITTEN = ("config", "model", "plant", "robot", "surface")
"""Stems of the files that `identify` and `twin` write."""


def label(value: object) -> str:
    """Return a value as text with paths reduced to their stems, also in "model:PATH+SECONDS" and "KIND:PATH@PLANT".

    A file with a name that `identify` or `twin` uses, such as my_robot/model.yaml, is reduced to its folder.
    """
    inner, at_sign, outer = str(value).rpartition("@")
    if at_sign and outer.partition(":")[0] in BUILT_IN:
        return f"{label(inner)}@{label(outer)}"
    kind, separator, rest = str(value).rpartition(":")
    folder, base = Path(rest).parent.name, Path(rest).name
    for suffix in (".yaml", ".yml", ".csv"):
        base = base.replace(suffix, "")
    stem, plus, delay = base.partition("+")
    return kind + separator + (folder if folder and stem in _WRITTEN else stem) + plus + delay
