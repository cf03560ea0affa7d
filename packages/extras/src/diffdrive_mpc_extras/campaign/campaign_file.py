"""A campaign as its YAML file states it, and the runs that are drawn from it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.stats import qmc

from diffdrive_mpc.bench.case import MAX_SEEDS, NO_MODEL, NO_SCENARIO, Case
from diffdrive_mpc.bench.peers import LAWS, PEERS
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import NotNegative
from diffdrive_mpc.models.suggestions import not_among
from diffdrive_mpc_extras.campaign.definition import Definition, check_factor
from diffdrive_mpc_extras.campaign.draws import Draw, Value, read_factor


class Condition(StrictModel):
    """Condition of a trial, and its description to the controller; omitted values are defaults."""

    plant: str = Field("mujoco", description="as --plant")
    surface: str = Field("default", description="as --surface")
    sensors: str = Field("default", description="as --sensors")
    scenario: str = Field(NO_SCENARIO, description="as --scenario")
    settings: dict[str, bool | int | float | str] = Field(
        default_factory=dict, description="configuration values of the robot, by dotted key"
    )

    def case(self, controller: str, model: str, trajectory: str, seed: int) -> Case:
        """Build one run under this condition; a peer has no model, and settings only if it uses the same estimate."""
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
        """Select conditions by name, by default all; raise ConfigError for an unknown name."""
        unknown = [name for name in names or () if name not in self.conditions]
        if unknown:
            raise ConfigError(f"{where}: unknown condition {not_among(unknown[0], self.conditions)}")
        return {name: self.conditions[name] for name in names or self.conditions}


def load_conditions(file: Path | None = None) -> Conditions:
    """Read a file of conditions, by default the shipped one; raises ConfigError when it has a mistake."""
    return load_checked(Conditions, file or Path(__file__).with_name("conditions.yaml"))


CONDITION = "condition"
"""Factor whose value is a condition of the robustness study: plant, surface, sensors, scenario and the values given to
the controller.
"""
MOST_RUNS = 100 * MAX_SEEDS
_SEED = "seed"
_INSIDE = 2.0**-33


class Campaign(StrictModel):
    """A list of runs, given by distributions of their factors."""

    description: str = Field(min_length=1, description="what it is for, in one line")
    runs: Annotated[int, Field(ge=1, le=MOST_RUNS)] = Field(description="how many runs")
    sampler: Literal["sobol", "latin_hypercube", "random"] = Field(
        "sobol",
        description="how points are spread, random: independently; only with latin_hypercube other runs for fewer",
    )
    draw_seed: Annotated[int, Field(ge=0)] = Field(0, description="seed of the points, not of a run's noise")
    conditions: str | None = Field(None, description="file of conditions in place of the shipped one")
    factors: dict[str, object] = Field(
        default_factory=dict, description="a value, a choice or a distribution for each factor"
    )

    @model_validator(mode="after")
    def _readable(self) -> Campaign:
        for name, data in self.factors.items():
            if name != CONDITION:
                check_factor(name, "factors")
            read_factor(data, f"factors.{name}")
        return self

    @property
    def draws(self) -> dict[str, Draw | Value]:
        """Every factor, in the order of the file; each run has its own seed where the file has none."""
        read = {name: read_factor(data, f"factors.{name}") for name, data in self.factors.items()}
        return read if _SEED in read else read | {_SEED: read_factor({"each": 0}, _SEED)}

    @property
    def varying(self) -> dict[str, Draw]:
        """The factors that differ from run to run."""
        return {name: draw for name, draw in self.draws.items() if isinstance(draw, Draw)}

    def definitions(self, runs: int | None = None) -> list[Definition]:
        """List the runs in order: the first `runs`, or as many as the file states.

        Raises ConfigError if there are too many, two factors contradict each other, or a value is of another kind than
        its factor.
        """
        count = self.runs if runs is None else runs
        if count > MOST_RUNS:
            raise ConfigError(f"--runs {count}: give at most {MOST_RUNS}")
        conditions = load_conditions(None if self.conditions is None else Path(self.conditions))
        sampled = [name for name, draw in self.varying.items() if draw.sampled]
        points = spread_points(self.sampler, count, len(sampled), self.draw_seed)
        definitions = []
        for index, row in enumerate(points):
            sampled_points = dict(zip(sampled, row.tolist(), strict=True))
            values = {
                name: draw.value(sampled_points.get(name, math.nan), index) if isinstance(draw, Draw) else draw
                for name, draw in self.draws.items()
            }
            definitions.append(Definition.from_factors(_with_condition(values, conditions), f"run {index}"))
        return definitions


def spread_points(sampler: str, count: int, dimensions: int, seed: int) -> FloatArray:
    """Distribute points (count, dimensions) evenly over (0, 1) by `sampler`."""
    if not dimensions:
        return np.zeros((count, 0))
    if sampler == "sobol":
        # A whole power of two is balanced, and its beginning is that of every larger one.
        power = max(count - 1, 1).bit_length()
        points = qmc.Sobol(dimensions, scramble=True, seed=seed).random_base2(power)[:count]
    elif sampler == "random":
        points = np.random.default_rng(seed).random((count, dimensions))
    else:
        points = qmc.LatinHypercube(dimensions, seed=seed).random(count)
    # A normal distribution has no quantile at the ends.
    return np.asarray(np.clip(points, _INSIDE, 1.0 - _INSIDE), dtype=float)


def load_campaign(path: str | Path) -> Campaign:
    """Read a campaign; files in its folder may be named by their relative path.

    Raises ConfigError when the file has a mistake.
    """
    read = load_checked(Campaign, path)
    return read.model_copy(update=files_beside(read, Path(path)))


def files_beside(campaign: Campaign, path: Path) -> dict[str, object]:
    """Return factors and conditions of a campaign file at `path`, with full paths of files next to it."""
    return {name: whole_paths(getattr(campaign, name), path.parent) for name in ("factors", "conditions")}


def whole_paths(value: object, folder: Path) -> object:
    """Replace names of files in `folder` by full paths in plain data."""
    if isinstance(value, Mapping):
        return {whole_paths(key, folder): whole_paths(inner, folder) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [whole_paths(inner, folder) for inner in value]
    if not isinstance(value, str) or not Path(value).suffix:
        return value
    kind, colon, rest = value.rpartition(":")
    file = folder / rest
    return f"{kind}{colon}{file.resolve()}" if file.is_file() else value


def _with_condition(values: dict[str, Value], conditions: Conditions) -> dict[str, Value]:
    """Replace a condition in the values by its own values."""
    name = values.pop(CONDITION, None)
    if name is None:
        return values
    condition = conditions.chosen([str(name)], f"factors.{CONDITION}")[str(name)]
    places: dict[str, Value] = {
        "plant": condition.plant,
        "surface": condition.surface,
        "sensors": condition.sensors,
        "scenario": condition.scenario,
    }
    twice = [place for place in places if place in values]
    if twice:
        raise ConfigError(f"factors.{twice[0]}: a condition sets that already; give one of them")
    return places | {f"config.{key}": value for key, value in condition.settings.items()} | values
