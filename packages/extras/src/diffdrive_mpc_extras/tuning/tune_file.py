"""Plan of a tuning: parameters with ranges, the runs that score a point, and the seeds."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from diffdrive_mpc.bench.case import MAX_CASES, MAX_SEEDS, check_count
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked

DEFAULT = Path(__file__).with_name("default.yaml")
Dimension = Literal["trajectory", "timing", "plant", "surface", "sensors", "scenario"]
Factor = Annotated[float, Field(gt=0)]


class SearchRange(StrictModel):
    """Range of a configuration value: factors on its start value, or two values."""

    times: tuple[Factor, Factor] | None = Field(None, description="minimum and maximum factor on the start value")
    low: float | None = Field(None, description="minimum value, in the unit of the key")
    high: float | None = Field(None, description="maximum value, in the unit of the key")
    log: bool = Field(False, description="true for a logarithmic scale; ranges with `times` always have one")

    @model_validator(mode="after")
    def _check_bounds(self) -> SearchRange:
        low, high = self.times or (self.low, self.high)
        if (self.times is None) == ((self.low, self.high) == (None, None)) or low is None or high is None:
            raise ValueError("use either times: [LOW, HIGH], or low and high")
        if not low < high:
            raise ValueError(f"the low end {low:g} is not below the high end {high:g}")
        if self.log and not low > 0.0:
            raise ValueError(f"log requires values above zero, low is {low:g}")
        return self

    def bounds(self, key: str, start: object) -> tuple[float, float]:
        """Return the minimum and maximum value of `key`.

        Raises ConfigError if `start`, its value in the configuration, is not a number or is outside the range.
        """
        if isinstance(start, bool) or not isinstance(start, (int, float)):
            raise ConfigError(f"parameters.{key}: its value is {start!r}; only numbers can be tuned, remove the key")
        if self.times is not None and not start > 0:
            raise ConfigError(f"parameters.{key}: times requires a value above zero, it is {start:g}; use low and high")
        low, high = [start * factor for factor in self.times] if self.times else [self.low or 0.0, self.high or 0.0]
        if not low <= start <= high:
            raise ConfigError(
                f"parameters.{key}: the configuration has {start:g}, which is not between {low:g} and {high:g}; "
                "widen the range"
            )
        return low, high


class SeedRange(StrictModel):
    """Consecutive seeds of the noise."""

    first: Annotated[int, Field(ge=0)]
    count: Annotated[int, Field(ge=1, le=MAX_SEEDS)]

    @property
    def seeds(self) -> range:
        """The seeds in order."""
        return range(self.first, self.first + self.count)


class TunePlan(StrictModel):
    """Content of the YAML file of a tuning."""

    description: str = Field(min_length=1, description="purpose in one line")
    points: Annotated[int, Field(ge=2, le=100_000)] = Field(description="number of configurations, including the start")
    sampler_seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = Field(0, description="seed of Optuna's sampler")
    parameters: Annotated[dict[str, SearchRange], Field(min_length=1)] = Field(
        description="ranges by key of the configuration"
    )
    runs: dict[Dimension, str | tuple[str, ...]] = Field(
        default_factory=dict, description="values by dimension of `diffdrive_mpc.sweep`"
    )
    adapt_to_robot: bool = Field(
        False, description="true: scale the paths to the robot of a configuration file, and skip two-sided limits"
    )
    failure_error: Factor = Field(0.5, description="minimum error of a failed run [m]")
    tuning_seeds: SeedRange = Field(description="seeds of the search")
    report_seeds: SeedRange = Field(description="seeds of the comparison")

    @field_validator("runs")
    @classmethod
    def _list_values(cls, runs: dict[str, str | tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
        return {name: (values,) if isinstance(values, str) else values for name, values in runs.items()}

    @model_validator(mode="after")
    def _check_seeds(self) -> TunePlan:
        tuning, report = self.tuning_seeds.seeds, self.report_seeds.seeds
        if max(tuning.start, report.start) < min(tuning.stop, report.stop):
            raise ValueError(f"report_seeds: {report.start} to {report.stop - 1} overlap with tuning_seeds")
        check_count(self.combinations * (self.points * len(tuning) + 2 * len(report)), MAX_CASES)
        return self

    @property
    def combinations(self) -> int:
        """Number of combinations of `runs`."""
        return math.prod(map(len, self.runs.values()))


def load_plan(path: Path | None = None) -> TunePlan:
    """Read a plan, by default the shipped one; raises ConfigError if it is invalid.

    Paths in the plan are relative to its folder.
    """
    file = path or DEFAULT
    plan = load_checked(TunePlan, file)
    runs = {name: tuple(_resolve(value, file.parent) for value in values) for name, values in plan.runs.items()}
    return plan.model_copy(update={"runs": runs})


def _resolve(name: str, folder: Path) -> str:
    kind, colon, file = name.rpartition(":")
    return f"{kind}{colon}{(folder / file).resolve()}" if (folder / file).is_file() else name
