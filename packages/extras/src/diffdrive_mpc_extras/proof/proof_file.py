"""Contents of a proof: a campaign, maps of two factors, and boundary searches of single factors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field, field_validator, model_validator

from diffdrive_mpc.bench.case import check_count
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked, read_yaml
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from diffdrive_mpc.sim.plants.names import MODEL
from diffdrive_mpc_extras.campaign.campaign_file import MAX_RUNS, Campaign, resolve_files, resolve_paths
from diffdrive_mpc_extras.campaign.definition import Definition, check_factor, file_value
from diffdrive_mpc_extras.campaign.draws import Value
from diffdrive_mpc_extras.campaign.engine import CampaignRun
from diffdrive_mpc_extras.campaign.own_plant import own_plant

PROOFS = Path(__file__).parent
DEFAULT = PROOFS / "default.yaml"
IDENTIFIED = PROOFS / "identified.yaml"
PLANT = "plant"


class MapAxis(StrictModel):
    """Axis of a map: a factor with its range, in the unit of the factor."""

    factor: str
    low: float
    high: float
    steps: Annotated[int, Field(ge=2, le=100)] = Field(description="number of values, including both ends")

    @model_validator(mode="after")
    def _check_axis(self) -> MapAxis:
        check_factor(self.factor, "maps")
        if not self.low < self.high:
            raise ValueError(f"low ({self.low:g}) must be below high ({self.high:g})")
        return self

    @property
    def values(self) -> list[float]:
        """Values from low to high."""
        width = (self.high - self.low) / (self.steps - 1)
        return [float(f"{self.low + k * width:.9g}") for k in range(self.steps)]


class Map(StrictModel):
    """Map over two factors."""

    x: MapAxis
    y: MapAxis


class BoundarySearch(StrictModel):
    """Search for the limit of a factor, between a value that should pass and a value that should fail."""

    holds: float = Field(description="value that should pass")
    beyond: float = Field(description="other end of the search range; smaller than `holds` to search downwards")
    within: Annotated[float, Field(gt=0)] = Field(description="width of the final interval of the search")
    unit: str = Field("", description="unit of the factor, for tables")

    @model_validator(mode="after")
    def _check_range(self) -> BoundarySearch:
        if abs(self.holds - self.beyond) <= self.within:
            raise ValueError("holds and beyond must differ by more than within")
        return self


class Probe(StrictModel):
    """Base run whose factors are varied by maps and searches."""

    factors: dict[str, bool | int | float | str] = Field(default_factory=dict, description="factors of the base run")
    seeds: Annotated[tuple[int, ...], Field(min_length=1)] = Field(
        description="seeds with which each value is simulated"
    )


class PassportPlan(StrictModel):
    """Plan of a speed passport: classes of curvature, speeds, surfaces, and number of robots for each."""

    share: Annotated[float, Field(gt=0, lt=1)] = Field(description="required share of robots within the tolerance [-]")
    confidence: Annotated[float, Field(gt=0, lt=1)] = Field(description="confidence of the share [-]")
    search_runs: Annotated[int, Field(ge=1)] = Field(description="number of robots at each speed of the search")
    proof_runs: Annotated[int, Field(ge=1)] = Field(description="number of new robots in each test")
    tries: Annotated[int, Field(ge=1)] = Field(description="maximum number of tests, each at a lower speed")
    draw_seed: Annotated[int, Field(ge=0)] = Field(description="seed of the robots")
    curvatures: Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=1)] = Field(
        description="increasing upper ends of the curvature classes, 0 for a straight line [1/m]"
    )
    speeds: Annotated[tuple[Annotated[float, Field(gt=0, le=1)], ...], Field(min_length=1)] = Field(
        description="increasing speeds of the grid, relative to the maximum under the limits [-]"
    )
    straight: Annotated[float, Field(gt=0)] = Field(
        description="duration of the straight lines before and after the arcs [s]"
    )
    arc: Annotated[float, Field(gt=0)] = Field(description="duration of the arc to each side [s]")
    factors: dict[str, object] = Field(default_factory=dict, description="additional factors")
    surfaces: Annotated[dict[str, dict[str, object]], Field(min_length=1)] = Field(
        description="surfaces by name, with factors that replace those of the campaign"
    )

    @model_validator(mode="after")
    def _check_plan(self) -> PassportPlan:
        if any(low >= high for values in (self.curvatures, self.speeds) for low, high in pairwise(values)):
            raise ValueError("curvatures and speeds must increase")
        max_level = self.share**self.proof_runs
        if max_level > (1.0 - self.confidence) / self.tries:
            raise ValueError(f"proof_runs: {self.proof_runs} robots cannot prove a share of {self.share:g}; give more")
        if self.share**self.search_runs > 1.0 - self.confidence:
            raise ValueError(
                f"search_runs: {self.search_runs} robots cannot prove a share of {self.share:g}; give more"
            )
        return self


class Proof(Campaign):
    """Campaign with optional maps and boundaries."""

    probe: Probe = Probe(seeds=(0,))
    band: Annotated[float, Field(gt=0)] = Field(
        default_factory=lambda: metric_settings().band,
        description="maximum distance from the path of a passing run [m]; by default that of sim/metrics",
    )
    passport: PassportPlan = Field(
        default_factory=dict,
        validate_default=True,
        description="plan for --tolerance; by default that of the default proof",
    )
    maps: dict[Annotated[str, Field(pattern="^[a-z-]+$")], Map] = Field(
        default_factory=dict, description="maps over two factors, by name, with the first seed of the probe"
    )
    boundaries: dict[str, BoundarySearch] = Field(default_factory=dict, description="boundary searches by factor")

    @field_validator("passport", mode="before")
    @classmethod
    def _complete_plan(cls, data: object) -> object:
        """Complete the plan with values of the default proof."""
        return read_yaml(DEFAULT)["passport"] | data if isinstance(data, Mapping) else data

    @model_validator(mode="after")
    def _check_number_of_runs(self) -> Proof:
        mapped = sum(axes.x.steps * axes.y.steps for axes in self.maps.values())
        # A search ends after at most thirty bisections, at nine digits.
        check_count(self.runs + mapped + 30 * len(self.boundaries) * len(self.probe.seeds), MAX_RUNS)
        return self

    @model_validator(mode="after")
    def _check_factor_names(self) -> Proof:
        for name in (*self.probe.factors, *self.boundaries):
            check_factor(name, "probe and boundaries")
        return self


def load_proof(path: Path | None) -> Proof:
    """Read a proof by shipped name or path, by default `default.yaml`; a campaign file is also a proof.

    Raises ConfigError if the file is missing or invalid.
    """
    file = named_file("proof", PROOFS, path) if path else DEFAULT
    read = load_checked(Proof, file)
    probe = read.probe.model_copy(update={"factors": resolve_paths(read.probe.factors, file.parent)})
    return read.model_copy(update=resolve_files(read, file) | {"probe": probe})


def proof_of(config: str, path: Path | None, plant: str | None) -> Proof:
    """Return the proof of a configuration on a plant, by default on that of the campaign file or `own_plant`.

    If no campaign file is given, an identified robot uses the shipped proof `identified`. Other plants use the default
    proof, in which all values of the robot are scaled from the papers' robot to the plant.

    Raises ConfigError as `load_proof`, if the configuration has no plant, or if the file names another plant.
    """
    proof = load_proof(path)
    if plant is None and PLANT in proof.factors:
        return proof
    if plant is not None and PLANT in proof.factors:
        raise ConfigError(f"--plant {plant}: {path} also names a plant; remove one of them")
    plant = plant or own_plant(config)
    if path is None:
        proof = load_proof(IDENTIFIED) if plant.startswith(f"{MODEL}:") else _scaled_to(plant, proof)
    probe = proof.probe.model_copy(update={"factors": {PLANT: plant} | dict(proof.probe.factors)})
    return proof.model_copy(update={"factors": proof.factors | {PLANT: plant}, "probe": probe})


def _scaled_to(plant: str, proof: Proof) -> Proof:
    """Return the proof with all values of `robot.` scaled by the ratio of the plant to the papers' robot."""

    def ratio(key: str) -> float:
        if not key.startswith("robot."):
            return 1.0
        # If the quantity of the plant is zero, such as a dead time, keep the values of the papers' robot.
        return file_value(key, {PLANT: plant}) / file_value(key, {}) or 1.0

    def factors(values: Mapping[str, object]) -> dict[str, object]:
        return {key: _scale(value, ratio(key)) for key, value in values.items()}

    def scaled(part: BaseModel, key: str, names: Sequence[str]) -> BaseModel:
        return part.model_copy(update={name: getattr(part, name) * ratio(key) for name in names})

    maps = {
        name: Map.model_validate({key: scaled(axis, axis.factor, ("low", "high")).model_dump() for key, axis in axes})
        for name, axes in proof.maps.items()
    }
    boundaries = {key: scaled(search, key, ("holds", "beyond", "within")) for key, search in proof.boundaries.items()}
    plan = proof.passport.model_copy(update={"factors": factors(proof.passport.factors)})
    return proof.model_copy(
        update={"factors": factors(proof.factors), "passport": plan, "maps": maps, "boundaries": boundaries}
    )


def _scale(value: object, ratio: float) -> object:
    """Multiply all numbers of a value or distribution by `ratio`."""
    if isinstance(value, Mapping):
        return {key: _scale(inner, ratio) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_scale(inner, ratio) for inner in value]
    return value * ratio if isinstance(value, float) and ratio != 1.0 else value


Drive = Callable[[list[Definition]], list[CampaignRun]]
"""Function that simulates distinct runs and returns them in order."""


@dataclass
class Boundary:
    """Boundary of a factor between passing and failing values.

    Attributes
    ----------
    factor
        Name of the factor.
    search
        Range and resolution of the search.
    held
        Passing value nearest to the boundary; None if the first value failed.
    failed
        Failing value nearest to the boundary; None if all values passed.
    values
        Number of passing seeds for each tried value.
    """

    factor: str
    search: BoundarySearch
    held: float | None = None
    failed: float | None = None
    values: dict[float, int] = field(default_factory=dict)

    @property
    def next_value(self) -> float | None:
        """Next value to try; None if the boundary is found."""
        if self.held is None:
            return self.search.holds if self.failed is None else None
        if self.failed is None:
            return self.search.beyond if self.held != self.search.beyond else None
        if abs(self.failed - self.held) <= self.search.within:
            return None
        middle = float(f"{0.5 * (self.held + self.failed):.9g}")
        return None if middle in self.values else middle  # no value of nine digits is in between

    def take(self, value: float, held: int, seeds: int) -> None:
        """Add the result of a value."""
        self.values[value] = held
        if held == seeds:
            self.held = value
        else:
            self.failed = value


def holds(run: CampaignRun, band: float) -> bool:
    """Return True if a run was completed within `band` [m] of its path."""
    return run.row["completed"] is True and run.number("lateral_max_m") <= band


def find_boundaries(
    searches: Mapping[str, BoundarySearch], probe: Definition, seeds: Sequence[int], drive: Drive, band: float
) -> list[Boundary]:
    """Search for the boundaries of several factors, each varied separately from `probe`; `band` [m] as in `holds`.

    The result must be monotone in each factor; values outside the search range are not tried.
    """
    boundaries = [Boundary(factor, search) for factor, search in searches.items()]
    while queries := [(boundary, value) for boundary in boundaries if (value := boundary.next_value) is not None]:
        runs = [_with(probe, boundary.factor, value).with_seed(seed) for boundary, value in queries for seed in seeds]
        driven = {run.definition: run for run in drive(runs)}
        for index, (boundary, value) in enumerate(queries):
            group_runs = runs[index * len(seeds) : (index + 1) * len(seeds)]
            boundary.take(value, sum(holds(driven[run], band) for run in group_runs), len(seeds))
    return boundaries


def _with(probe: Definition, factor: str, value: Value) -> Definition:
    return probe.with_factors({factor: value})


# Runs of a map, and their results.


@dataclass(frozen=True)
class DrivenMap:
    """Results of a map, (rows, columns) with a row for each value of y and a column for each value of x.

    Attributes
    ----------
    name, axes
        Name and axes of the map.
    error
        Position RMSE [m]; NaN for a run without ticks.
    lateral
        Maximum |lateral| [m].
    completed
        1 if the run was completed, else 0.
    """

    name: str
    axes: Map
    error: FloatArray
    lateral: FloatArray
    completed: FloatArray


def map_runs(axes: Map, probe: Definition, seed: int) -> list[Definition]:
    """List the runs of a map, row by row."""
    return [
        probe.with_factors({axes.x.factor: x, axes.y.factor: y}).with_seed(seed)
        for y in axes.y.values
        for x in axes.x.values
    ]


def drawn_map(name: str, axes: Map, runs: Sequence[Definition], driven: Sequence[CampaignRun]) -> DrivenMap:
    """Collect the results of the runs of `map_runs`."""
    by_run = {run.definition: run for run in driven}
    shape = (axes.y.steps, axes.x.steps)

    def grid(column: str) -> FloatArray:
        return np.array([by_run[run].number(column) for run in runs]).reshape(shape)

    return DrivenMap(name, axes, grid("position_rmse_m"), grid("lateral_max_m"), grid("completed"))
