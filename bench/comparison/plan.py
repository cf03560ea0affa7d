"""Selection of the cases of a comparison."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, create_model

from diffdrive_mpc.bench.case import (
    BY_OSQP,
    DIMENSIONS,
    HORIZONS,
    NO_MODEL,
    OSQP_MODEL,
    Case,
    Overrides,
    check_count,
    combinations,
    label,
    split_numbers,
)
from diffdrive_mpc.bench.comparison.other_robots import dynamics_cases, population_cases
from diffdrive_mpc.bench.controllers import CONTROLLERS, check_cases, controller_config, select_model
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.sweep import sweep_settings
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel
from diffdrive_mpc.models.suggestions import format_unknown_name


class ComparisonSettings(StrictModel):
    """Settings of a comparison; a subclass adds the values of each dimension under its plural name."""

    horizons: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (), description="horizons of the sweep [steps]; empty: no sweep"
    )
    config: str | None = Field(None, description="controller configuration file that replaces the built-in files")
    settings: tuple[Overrides, ...] = Field(((),), description="combinations of swept configuration values")
    scaled: bool = Field(False, description="true to scale paths to the robot of the configuration")
    osqp: bool = Field(True, description="true to also compare OSQP at every tick")
    beyond: bool = Field(False, description="true to run further speeds, dead times and seeds, see `CasePlan`")
    robots: bool = Field(False, description="true to run further robots, see `other_robots`")

    def values(self, dimension: str) -> tuple[Any, ...]:
        """Return the values of a dimension by its plural name."""
        values: tuple[Any, ...] = getattr(self, dimension)
        return values

    @property
    def has_mpc(self) -> bool:
        """True if the controllers include the predictive controller, which has a model and a configuration."""
        return not set(self.values("controllers")) <= set(PEERS)


SPEEDS = (0.3, 0.6, 0.9, 1.2)
"""Maximum speeds of the speed sweep [m/s]."""
SPEED_TRAJECTORIES, SPEED_SEEDS = ("circle", "s"), 1
"""Trajectories and number of seeds of the speed sweep."""
SWEPT_TRAJECTORIES = ("s", "cane")
"""Trajectories of the horizon sweep; results for other trajectories are similar."""
LATE_TICKS, LATE_TRAJECTORY = (-2, 0, 2, 4), "s"
"""Dead time of the plant minus configured dead time [samples], and trajectory of the dead time sweep."""
OTHER_SEEDS = (10, 11)
"""Additional seeds for a check of the ranking of the controllers."""
ROBOT_SEEDS = tuple(range(0, 40, 2))
"""Seeds of the runs with `KnownRobot` in a sweep."""

_DIMENSIONS: dict[str, Any] = {
    entry.plural: (Annotated[tuple[entry.kind, ...], Field(min_length=1)], entry.compared)  # type: ignore[name-defined]
    for entry in DIMENSIONS
}
_WithDimensions = create_model("ComparisonSettings", __base__=ComparisonSettings, **_DIMENSIONS)


def default_settings() -> ComparisonSettings:
    """Return the default settings of `bench`."""
    return _WithDimensions()


def read_options(
    values: Mapping[str, str | None],
    *,
    horizons: str | None = None,
    config: Path | None = None,
    settings: Sequence[str] = (),
    quick: bool = False,
    scaled: bool = False,
    sweeps: bool = False,
) -> ComparisonSettings:
    """Convert the options of the command to settings.

    Parameters
    ----------
    values
        Text of the option of each dimension by plural name; None if the option was not passed.
    horizons, config, settings, quick, scaled, sweeps
        Other options of the command.

    Raise ConfigError or ValueError if an option cannot be used.
    """
    default = default_settings()
    requested = {dimension: text for dimension in DIMENSIONS if (text := values.get(dimension.plural)) is not None}
    options: dict[str, object] = {
        entry.plural: entry.read(text, entry.list_option) for entry, text in requested.items()
    }
    if "controllers" not in options and (config is not None or settings or "models" in options):
        options["controllers"] = ("mpc",)  # these options apply only to the predictive controller
    if sweeps and (quick or config or settings or scaled or set(options) - {"controllers", "models", "seeds"}):
        raise ConfigError("--sweeps: combine it only with --controllers, --models, --seeds and --horizons")
    options["osqp"] = not (config or settings or {"controllers", "models"} & set(options))
    chosen_settings = default.model_copy(
        update={"settings": tuple(sweep_settings(settings)), "scaled": scaled, **options}
    )
    if not chosen_settings.has_mpc:
        if any((values.get("models") is not None, config is not None, settings, horizons is not None)):
            name = chosen_settings.values("controllers")[0]
            raise ConfigError(f"the controller '{name}' takes no --models, --config, --set or --horizons")
        options["horizons"] = ()
    elif horizons is not None:
        options["horizons"] = _horizons(horizons, settings)
    elif sweeps:
        options["horizons"] = HORIZONS
    if config is not None:
        options = {"config": str(config), "models": (select_model(None, config),)} | options
    options["beyond"] = sweeps
    options["robots"] = not (quick or scaled or settings or set(options) - {"osqp", "beyond", "horizons"})
    if quick:
        options.setdefault("seeds", default.values("seeds")[:1])
    return chosen_settings.model_copy(update=options)


def _horizons(text: str, settings: Sequence[str]) -> tuple[int, ...]:
    if text.strip().lower() == "none":
        return ()
    if any(setting.partition("=")[0].strip() == "horizon" for setting in settings):
        raise ConfigError("--horizons and --set horizon=...: give one of them")
    return split_numbers(text, "--horizons", minimum=1)


@dataclass(frozen=True)
class CasePlan:
    """Cases of a comparison; a case that belongs to several parts is run only once.

    Attributes
    ----------
    main
        All combinations of controllers, models, settings and the other dimensions.
    horizon
        All combinations of models, horizons and `SWEPT_TRAJECTORIES`, with the first value of the other dimensions.
    speed, dead_time
        All controllers with other maximum speeds, and on plants with a longer or shorter dead time than configured. A
        controller without a configurable dead time is run only on plants with a longer dead time.
    other_seeds
        Cases of `main` with other seeds.
    population, dynamics
        Cases with other robots, see `other_robots`.
    """

    main: tuple[Case, ...]
    horizon: tuple[Case, ...]
    speed: tuple[Case, ...] = ()
    dead_time: tuple[Case, ...] = ()
    other_seeds: tuple[Case, ...] = ()
    population: tuple[Case, ...] = ()
    dynamics: tuple[Case, ...] = ()

    @property
    def all(self) -> tuple[Case, ...]:
        """Cases whose whole runs are stored, without repetition, in order."""
        return tuple(dict.fromkeys((*self.main, *self.horizon)))

    @property
    def timed_cases(self) -> tuple[Case, ...]:
        """Cases whose steps are timed; only the first seed, since step times do not depend on the seed."""
        return tuple(case for case in self.all if case.seed == self.main[0].seed)

    @property
    def sweep_cases(self) -> tuple[Case, ...]:
        """Cases of which only rows are stored, without repetition, in order."""
        cases = (*self.speed, *self.dead_time, *self.other_seeds, *self.population, *self.dynamics)
        return tuple(case for case in dict.fromkeys(cases) if case not in set(self.all))


def plan_cases(settings: ComparisonSettings) -> CasePlan:
    """List the cases, and check that their values exist and can be used.

    Raise ConfigError or ValueError if a value of a dimension or of the configuration cannot be used, or two values
    would have the same name in tables and figures.
    """
    controllers, models = settings.values("controllers"), settings.values("models")
    unknown = [name for name in controllers if name not in CONTROLLERS]
    if unknown:
        raise ConfigError(f"unknown controller {format_unknown_name(unknown[0], CONTROLLERS)}")
    _check_labels(settings)
    mpc_cases = (
        [Case(model=model, config=settings.config, scaled=settings.scaled) for model in models]
        if settings.has_mpc
        else []
    )
    drivers = [replace(case, overrides=values) for case in mpc_cases for values in settings.settings]
    if any(controller_config(case.model, case.config, case.overrides).start_delay for case in drivers):
        raise ConfigError("start_delay: bench runs do not delay the start; remove it, or use simulate")
    peers = {
        name: [Case(controller=name, model=NO_MODEL, scaled=settings.scaled)] for name in controllers if name in PEERS
    }
    # Trajectories and seeds vary fastest in the list of cases.
    several = {dimension.name: settings.values(dimension.plural) for dimension in DIMENSIONS if dimension.place}
    several |= {"trajectory": settings.values("trajectories"), "seed": settings.values("seeds")}
    places = [{name: getattr(case, name) for name in several} for case in combinations(**several)]
    driven_by = {name: peers.get(name, drivers) for name in controllers}
    by_osqp = [replace(case, overrides=BY_OSQP) for case in mpc_cases if settings.osqp and case.model == OSQP_MODEL]
    compared = [*itertools.chain.from_iterable(driven_by.values()), *by_osqp]
    check_count(len(compared) * len(places))
    main = [replace(driver, **place) for driver in compared for place in places]
    first = {name: values[0] for name, values in several.items() if name != "trajectory"}
    swept = [entry for entry in several["trajectory"] if not settings.beyond or entry in SWEPT_TRAJECTORIES]
    check_count(len(mpc_cases) * len(settings.horizons) * len(swept))
    horizon = [
        _at_horizon(replace(case, overrides=settings.settings[0], trajectory=trajectory, **first), steps)
        for case, steps, trajectory in itertools.product(mpc_cases, settings.horizons, swept)
    ]
    plan = CasePlan(tuple(main), tuple(horizon))
    if settings.beyond:
        each = [replace(case, **first) for name in controllers for case in driven_by[name]]
        seeds = several["seed"][:SPEED_SEEDS]
        plan = replace(
            plan,
            speed=tuple(
                replace(case, trajectory=trajectory, top_speed=speed, seed=seed)
                for case, trajectory, speed, seed in itertools.product(each, SPEED_TRAJECTORIES, SPEEDS, seeds)
            ),
            dead_time=tuple(
                _with_excess_delay(replace(case, trajectory=LATE_TRAJECTORY), ticks)
                for case, ticks in itertools.product(each, LATE_TICKS)
                if ticks >= 0 or case.controller not in PEERS
            ),
            other_seeds=tuple(
                dict.fromkeys(replace(case, seed=seed) for case, seed in itertools.product(main, OTHER_SEEDS))
            ),
        )
    check_cases((*plan.all, *plan.sweep_cases))
    if not settings.robots:
        return plan
    # Cases of other robots are not checked, because their files are built-in and the check takes several seconds.
    population, dynamics = (
        population_cases(whole=settings.beyond),
        dynamics_cases(ROBOT_SEEDS if settings.beyond else None),
    )
    return replace(plan, population=population, dynamics=dynamics)


def _with_excess_delay(case: Case, ticks: int) -> Case:
    """Return the case with `ticks` of additional dead time in the plant or, if negative, in the configuration."""
    if ticks >= 0:
        return replace(case, late=ticks)
    config = controller_config(case.model, case.config, case.overrides)
    for channel in ("v", "omega"):
        requested = getattr(config.extra_dead_time, channel) - ticks * config.sample_time
        case = case.with_override(f"extra_dead_time.{channel}", round(requested, 6))
    return replace(case, late=ticks)


def _at_horizon(case: Case, steps: int) -> Case:
    """Return the case with a horizon of `steps`; an equal horizon returns the same case, so that it is run once."""
    return case if case.horizon == steps else case.with_override("horizon", steps)


def _check_labels(settings: ComparisonSettings) -> None:
    """Raise ConfigError if two files of a dimension have the same stem, because tables and figures would merge them.

    Models and peers must not share a name. The comparison ignores case, because figure files use these names.
    """
    dimensions = {dimension.plural: settings.values(dimension.plural) for dimension in DIMENSIONS}
    peers = tuple(name for name in dimensions.pop("controllers") if name in PEERS)
    dimensions["models"] = (*peers, *dimensions["models"]) if settings.has_mpc else peers
    for dimension, names in dimensions.items():
        labels: dict[str, str] = {}
        for name in names:
            other_name = labels.setdefault(label(name).casefold(), name)
            if other_name != name:
                raise ConfigError(
                    f"{dimension}: '{other_name}' and '{name}' would both be '{label(name)}' in tables and figures; "
                    f"rename one file"
                )
