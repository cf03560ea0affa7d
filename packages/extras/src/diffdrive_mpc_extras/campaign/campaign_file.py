"""Campaign files, conditions, and the runs drawn from a campaign."""

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
from diffdrive_mpc.models.suggestions import format_unknown_name
from diffdrive_mpc_extras.campaign.definition import Definition, check_factor
from diffdrive_mpc_extras.campaign.draws import Draw, Value, read_factor


class Condition(StrictModel):
    """Condition of a trial, with the controller settings for it; omitted values are defaults."""

    plant: str = Field("mujoco", description="plant, as for --plant")
    surface: str = Field("default", description="surface, as for --surface")
    sensors: str = Field("default", description="sensors, as for --sensors")
    scenario: str = Field(NO_SCENARIO, description="scenario, as for --scenario")
    settings: dict[str, bool | int | float | str] = Field(
        default_factory=dict, description="configuration values of the robot, by dotted key"
    )

    def case(self, controller: str, model: str, trajectory: str, seed: int) -> Case:
        """Build one run under this condition.

        A peer has no model, and uses the settings only if it shares the estimator of the controller.
        """
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

    settled: NotNegative = Field(description="time after which the maximum lateral error is evaluated [s]")
    quick: tuple[str, ...] = Field((), description="conditions of a quick study; empty for all conditions")
    conditions: Annotated[dict[str, Condition], Field(min_length=1)]

    @model_validator(mode="after")
    def _known(self) -> Conditions:
        self.select(self.quick or None, "quick")
        return self

    def select(self, names: Sequence[str] | None, where: str = "--only") -> dict[str, Condition]:
        """Select conditions by name, by default all; raises ConfigError for an unknown name."""
        unknown = [name for name in names or () if name not in self.conditions]
        if unknown:
            raise ConfigError(f"{where}: unknown condition {format_unknown_name(unknown[0], self.conditions)}")
        return {name: self.conditions[name] for name in names or self.conditions}


def load_conditions(file: Path | None = None) -> Conditions:
    """Read a file of conditions, by default the shipped one; raises ConfigError if it is invalid."""
    return load_checked(Conditions, file or Path(__file__).with_name("conditions.yaml"))


CONDITION = "condition"
"""Factor whose value is a condition: plant, surface, sensors, scenario and controller settings."""
MAX_RUNS = 100 * MAX_SEEDS
_SEED = "seed"
_MIN_POINT = 2.0**-33


class Campaign(StrictModel):
    """Campaign: a number of runs, and the distributions of their factors."""

    description: str = Field(min_length=1, description="purpose of the campaign, in one line")
    runs: Annotated[int, Field(ge=1, le=MAX_RUNS)] = Field(description="number of runs")
    sampler: Literal["sobol", "latin_hypercube", "random"] = Field(
        "sobol",
        description="sampling method; with latin_hypercube, a different number of runs changes all points",
    )
    draw_seed: Annotated[int, Field(ge=0)] = Field(
        0, description="seed of the sampled points; the noise has separate seeds"
    )
    conditions: str | None = Field(None, description="file of conditions; by default the shipped file")
    factors: dict[str, object] = Field(default_factory=dict, description="value, choice or distribution of each factor")

    @model_validator(mode="after")
    def _check_factors(self) -> Campaign:
        for name, data in self.factors.items():
            if name != CONDITION:
                check_factor(name, "factors")
            read_factor(data, f"factors.{name}")
        return self

    @property
    def draws(self) -> dict[str, Draw | Value]:
        """All factors in the order of the file; by default, the seed is the index of the run."""
        read = {name: read_factor(data, f"factors.{name}") for name, data in self.factors.items()}
        return read if _SEED in read else read | {_SEED: read_factor({"each": 0}, _SEED)}

    @property
    def varying(self) -> dict[str, Draw]:
        """Factors that differ from run to run."""
        return {name: draw for name, draw in self.draws.items() if isinstance(draw, Draw)}

    def definitions(self, runs: int | None = None) -> list[Definition]:
        """List the runs in order: the first `runs`, by default the number in the file.

        Raises ConfigError if there are too many runs, if two factors set the same value, or if a value has a wrong
        type.
        """
        count = self.runs if runs is None else runs
        if count > MAX_RUNS:
            raise ConfigError(f"--runs {count}: give at most {MAX_RUNS}")
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
        # Powers of two are balanced, and a shorter sequence is the start of each longer one.
        power = max(count - 1, 1).bit_length()
        points = qmc.Sobol(dimensions, scramble=True, seed=seed).random_base2(power)[:count]
    elif sampler == "random":
        points = np.random.default_rng(seed).random((count, dimensions))
    else:
        points = qmc.LatinHypercube(dimensions, seed=seed).random(count)
    # The quantiles of a normal distribution at 0 and 1 are infinite.
    return np.asarray(np.clip(points, _MIN_POINT, 1.0 - _MIN_POINT), dtype=float)


def load_campaign(path: str | Path) -> Campaign:
    """Read a campaign; relative paths of files start at its folder.

    Raises ConfigError if the file is invalid.
    """
    campaign = load_checked(Campaign, path)
    return campaign.model_copy(update=resolve_files(campaign, Path(path)))


def resolve_files(campaign: Campaign, path: Path) -> dict[str, object]:
    """Return factors and conditions of a campaign file at `path`, with absolute paths of files in its folder."""
    return {name: resolve_paths(getattr(campaign, name), path.parent) for name in ("factors", "conditions")}


def resolve_paths(value: object, folder: Path) -> object:
    """Replace names of files in `folder` by absolute paths, in nested plain data."""
    if isinstance(value, Mapping):
        return {resolve_paths(key, folder): resolve_paths(inner, folder) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [resolve_paths(inner, folder) for inner in value]
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
    condition = conditions.select([str(name)], f"factors.{CONDITION}")[str(name)]
    settings: dict[str, Value] = {
        "plant": condition.plant,
        "surface": condition.surface,
        "sensors": condition.sensors,
        "scenario": condition.scenario,
    }
    duplicates = [setting for setting in settings if setting in values]
    if duplicates:
        raise ConfigError(f"factors.{duplicates[0]}: also set by the condition; remove one of them")
    return settings | {f"config.{key}": value for key, value in condition.settings.items()} | values
