"""What a tuning consists of: parameters with ranges, what is to be small, what must hold, and on which runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from diffdrive_mpc.bench.case import check_count
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.sim import Metrics
from diffdrive_mpc.sim.metrics.recovery import Recovery
from diffdrive_mpc_extras.campaign.campaign_file import MOST_RUNS, Campaign, whole_paths
from diffdrive_mpc_extras.campaign.definition import Definition, check_factor, stated
from diffdrive_mpc_extras.campaign.draws import Value, read_factor

DEFAULT = Path(__file__).with_name("default.yaml")
Count = Annotated[int, Field(ge=1, le=10_000)]
Seed = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(gt=0)]
Figure = Literal["mean", "cvar"]
Factors = dict[str, bool | int | float | str]
Weighted = dict[str, dict[Figure, Share]]
_CONTROLLER = ("controller", "model", "config")
COLUMNS = (
    *(of.name for of in fields(Metrics) if not of.name.startswith(("step_time", "solve_time", "deadline"))),
    *(f"recovery_{of.name.removeprefix('recovery_')}" for of in fields(Recovery)),
)
"""Columns of a run's row that an objective or a constraint may name."""


class SearchRange(StrictModel):
    """Where a value of the configuration is searched: as factors of what it is now, or between two values."""

    times: tuple[Share, Share] | None = Field(None, description="lowest and highest factor on what it is now")
    low: float | None = Field(None, description="lowest value, in the unit of the key")
    high: float | None = Field(None, description="highest value")
    log: bool = Field(False, description="whether ratios count between low and high; with `times` they always do")

    @model_validator(mode="after")
    def _one_way(self) -> SearchRange:
        low, high = self.times or (self.low, self.high)
        if (self.times is None) == ((self.low, self.high) == (None, None)) or low is None or high is None:
            raise ValueError("give either times: [LOW, HIGH], or low and high")
        if not low < high:
            raise ValueError("the lower end has to be below the higher one")
        if self.times is not None and not low <= 1.0 <= high:
            raise ValueError("times: what it is now, a factor of 1, has to lie within")
        if self.log and not low > 0.0:
            raise ValueError("log takes values above zero")
        return self


class Objective(StrictModel):
    """What is to be small: figures of columns over the runs, each over that of the defaults, weighted.

    The defaults have an objective of 1.
    """

    error: Annotated[Weighted, Field(min_length=1)] = Field(description="by column: weight of mean or cvar")
    effort: Weighted = Field(default_factory=dict, description="the same, for what commands cost")

    @model_validator(mode="after")
    def _known(self) -> Objective:
        for column in (*self.error, *self.effort):
            _check_column(column)
        return self


class Constraint(StrictModel):
    """A column that may be no larger in any run than a value, or than a factor on the largest of the defaults."""

    column: str
    at_most: float | None = Field(None, description="in the unit of the column")
    times: Share | None = Field(None, description="on the largest value of the defaults")
    runs: Annotated[int, Field(ge=0, le=1000)] = Field(
        0, description="so many runs of its own, with `factors`, of points that reach the last fidelity; 0: all others"
    )
    factors: Factors = Field(default_factory=dict, description="what these runs have in place of the others' factors")

    @model_validator(mode="after")
    def _one_limit(self) -> Constraint:
        _check_column(self.column)
        if (self.at_most is None) == (self.times is None):
            raise ValueError("give either at_most or times")
        if self.factors and not self.runs:
            raise ValueError("factors: say how many runs have them, in runs")
        return self


class StepTime(StrictModel):
    """A limit on the 99th percentile of the step time on a machine that is named."""

    machine: str = Field(min_length=1, description="where it was measured, for the report")
    p99: Share = Field(description="what it is there with the horizon that the configuration has now [s]")
    at_most: Share = Field(description="what it may be there [s]")


class Fidelity(StrictModel):
    """Runs that a point is judged by before it goes on."""

    runs: Count
    factors: Factors = Field(default_factory=dict, description="what these runs have in place of the others' factors")


class TuneRuns(StrictModel):
    """Which runs: points of the spread and seeds of the noise."""

    draw_seed: Seed = Field(description="of the points of the spread")
    first_seed: Seed = Field(description="of the noise; the next run has the next one")


class ValidationRuns(TuneRuns):
    """Runs that the search has not seen, on which the chosen point is held against the defaults."""

    runs: Annotated[int, Field(ge=2, le=10_000)]
    put_back: Annotated[int, Field(ge=0, le=10_000)] = Field(
        0, description="so many of them also with each parameter alone put back to its default; 0: without"
    )


class TunePlan(StrictModel):
    """A tuning as its YAML file states it."""

    description: str = Field(min_length=1, description="what it is for, in one line")
    points: Annotated[int, Field(ge=2, le=100_000)] = Field(description="how many are tried, the defaults included")
    at_once: Count = Field(description="points that are asked for together")
    keep: Annotated[int, Field(ge=2, le=100)] = Field(3, description="one of so many goes on to the next fidelity")
    search_seed: Seed = Field(0, description="of the sampler")
    parameters: Annotated[dict[str, SearchRange], Field(min_length=1)] = Field(
        description="by key of the configuration"
    )
    objective: Objective
    constraints: dict[Annotated[str, Field(pattern="^[a-z_]+$")], Constraint] = Field(default_factory=dict)
    step_time: StepTime | None = None
    fidelities: Annotated[tuple[Fidelity, ...], Field(min_length=1)]
    tuning: TuneRuns
    verdict: ValidationRuns
    factors: dict[str, object] = Field(default_factory=dict, description="as in a campaign")
    spread: dict[str, tuple[float, float]] = Field(
        default_factory=dict, description="lowest and highest factor on what plant, floor or sensors say"
    )

    @model_validator(mode="after")
    def _apart(self) -> TunePlan:
        own = [fidelity.factors for fidelity in self.fidelities] + [
            constraint.factors for constraint in self.constraints.values()
        ]
        for name in (*self.factors, *self.spread, *(key for factors in own for key in factors)):
            check_factor(name, "factors and spread")
            if name in (*_CONTROLLER, "seed") or name.startswith("config."):
                raise ValueError(f"factors.{name}: the tuning itself says that; leave it out")
        for name, data in self.factors.items():
            read_factor(data, f"factors.{name}")
        most = max(
            [fidelity.runs for fidelity in self.fidelities]
            + [constraint.runs for constraint in self.constraints.values()]
        )
        tuned = range(self.tuning.first_seed, self.tuning.first_seed + most)
        judged = range(self.verdict.first_seed, self.verdict.first_seed + self.verdict.runs)
        if max(tuned.start, judged.start) < min(tuned.stop, judged.stop):
            raise ValueError(f"verdict.first_seed: seeds from {judged.start} on are those of the tuning; give others")
        return self

    @model_validator(mode="after")
    def _can_be_driven(self) -> TunePlan:
        # At least: each fidelity drives what the one before has kept.
        kept = [-(-self.points // self.keep**k) for k in range(len(self.fidelities))]
        searched = sum(points * of.runs for points, of in zip(kept, self.fidelities, strict=True))
        alone = self.verdict.put_back * len(self.parameters)
        check_count(searched + 2 * self.verdict.runs + alone, MOST_RUNS)
        return self

    def runs(
        self, of: TuneRuns, count: int, usual: Mapping[str, Value], factors: Mapping[str, object]
    ) -> list[Definition]:
        """`count` runs of the controller that `usual` names, with `factors` in place of the plan's.

        Raises ConfigError if a factor has a mistake, or plant, floor or sensors have no value that is to be spread.
        """
        drawn = dict(self.factors) | dict(factors) | {"seed": {"each": of.first_seed}}
        for key, (low, high) in self.spread.items():
            value = stated(key, drawn)
            drawn[key] = {"uniform": sorted((low * value, high * value))}
        campaign = Campaign(description=self.description, runs=count, draw_seed=of.draw_seed, factors=drawn)
        return [definition.changed(usual) for definition in campaign.definitions()]


def load_plan(path: Path | None = None) -> TunePlan:
    """Read a plan, by default the shipped one; raises ConfigError when it has a mistake."""
    file = path or DEFAULT
    read = load_checked(TunePlan, file)
    return read.model_copy(update={"factors": whole_paths(read.factors, file.parent)})


def _check_column(column: str) -> None:
    if column not in COLUMNS:
        raise ValueError(f"there is no column '{column}'; known: {', '.join(COLUMNS)}")
