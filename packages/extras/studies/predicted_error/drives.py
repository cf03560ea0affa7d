"""Drives of the study: sets, simulation and storage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.runner import StudyFailedError
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import ahead_and_left
from diffdrive_mpc.mpc import Controller, Trajectory, load_trajectory
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.plants.drawn_robot import Span
from diffdrive_mpc.sim.plants.make import drawn_robot
from diffdrive_mpc.sim.plants.names import DRAWN
from diffdrive_mpc_extras.campaign.campaign_file import Campaign
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.drivable_robots import driving_seeds
from diffdrive_mpc_extras.campaign.drive import built
from diffdrive_mpc_extras.predicted_error.calibration import FEATURES, CalibratedRange, CalibratedRanges, path_features

Count = Annotated[int, Field(ge=1)]
PARTS = ("fit", "calibration", "test")
_QUICK_RUNS = 20
"""Number of runs of a quick study; fewer runs have no 95 % quantile."""
TICKS_PER_PLACE = 5
"""Number of ticks that form one place; its error is their maximum |error|."""
_PATH_STREAM = 37


class DriveSet(StrictModel):
    """Set of drives with common factors."""

    runs: Count = Field(description="number of drives")
    draw_seed: int = Field(0, ge=0, description="seed of the factors")
    robots: Literal["tuning", "reserved"] | None = Field(None, description="robots of the market; null: from factors")
    first_robot: int = Field(0, ge=0, description="index of the first robot among the drivable robots")
    first_path: int | None = Field(None, ge=0, description="seed of the first random path; null: from factors")
    like: str | None = Field(None, description="population whose factors apply as well")
    factors: dict[str, object] = Field(default_factory=dict, description="factors, as in a campaign")


class PopulationDrives(StrictModel):
    """Population, and its sets of drives."""

    description: str = Field(min_length=1, description="description of robots and surfaces")
    factors: dict[str, object] = Field(default_factory=dict, description="common factors of all sets")
    fit: DriveSet = Field(description="drives for the coefficients")
    calibration: DriveSet = Field(description="drives for the quantiles")
    test: DriveSet = Field(description="drives for the coverage, with held-out robots, paths and seeds")


class Oracle(StrictModel):
    """Repeated drives of paths, for reference tubes."""

    drives: Count = Field(description="number of drives of each path")
    first_robot: int = Field(0, ge=0, description="index of the first reserved robot")
    first_seed: int = Field(0, ge=0, description="noise seed of the first drive")
    draw_seed: int = Field(0, ge=0, description="seed of the factors for the first path")
    paths: tuple[int, ...] = Field(description="seeds of random paths")


class PredictedErrorFile(StrictModel):
    """Content of the study file."""

    level: float = Field(gt=0.5, lt=1.0, description="share of drives inside a tube [-]")
    speed: CalibratedRange = Field(description="range of the maximum speed of a path [m/s]")
    yaw_rate: CalibratedRange = Field(description="range of the maximum yaw rate of a path [rad/s]")
    acceleration: Span = Field(description="range of the factor on the default accelerations of references [-]")
    lag_v: CalibratedRange = Field(description="range of the models' lag of v, including dead time [s]")
    lag_omega: CalibratedRange = Field(description="range of the models' lag of omega, including dead time [s]")
    populations: dict[str, PopulationDrives] = Field(description="calibrated populations")
    others: dict[str, DriveSet] = Field(default_factory=dict, description="test sets outside the populations")
    oracle: Oracle = Field(Oracle(drives=1, paths=()), description="repeated drives for reference tubes")

    @property
    def calibrated_ranges(self) -> CalibratedRanges:
        """Ranges of paths and models for which the tubes are calibrated."""
        return CalibratedRanges(v=self.speed, omega=self.yaw_rate, lag_v=self.lag_v, lag_omega=self.lag_omega)

    def path(self, seed: int) -> Trajectory:
        """Return the random path of a seed, timed with limits that the seed draws."""
        stream = np.random.default_rng([seed, _PATH_STREAM])
        spans = (self.speed, self.yaw_rate, self.acceleration)
        speed, yaw_rate, factor = (float(np.exp(stream.uniform(*np.log(span)))) for span in spans)
        default = TrajectoryLimits.of_robot()
        limits = replace(
            default,
            v=speed,
            omega=yaw_rate,
            v_acceleration=factor * default.v_acceleration,
            omega_acceleration=factor * default.omega_acceleration,
            lateral_acceleration=factor * default.lateral_acceleration,
        )
        return load_trajectory(f"spline-{seed}", limits)


@dataclass(frozen=True)
class PlannedDrive:
    """Run of a campaign, and the seed of its random path; None for the path of the run."""

    definition: Definition
    path: int | None


@dataclass(frozen=True)
class DrivenPath:
    """Data of a drive at n places.

    Attributes
    ----------
    features
        (n, len(FEATURES)) features of path and configuration.
    errors
        |error| (n,) [m] by direction; infinite after an early end of the drive.
    speed
        Mean speed of the reference [m/s].
    friction
        Friction coefficient of the surface [-]; NaN for a plant without friction.
    """

    features: FloatArray
    errors: Mapping[str, FloatArray]
    speed: float
    friction: float


def load_study(path: Path | None, *, quick: bool = False) -> PredictedErrorFile:
    """Read a study file, by default the shipped one; a quick study has few drives.

    Raises ConfigError if the file is invalid.
    """
    study = load_checked(PredictedErrorFile, path or Path(__file__).with_name("study.yaml"))
    if not quick:
        return study
    name, first = next(iter(study.populations.items()))
    sets = {part: getattr(first, part).model_copy(update={"runs": _QUICK_RUNS}) for part in PARTS}
    return study.model_copy(
        update={
            "populations": {name: first.model_copy(update=sets)},
            "others": {"dropouts": study.others["dropouts"].model_copy(update={"runs": 2})},
            "oracle": study.oracle.model_copy(update={"drives": 5}),
        }
    )


def planned_sets(study: PredictedErrorFile) -> dict[str, list[PlannedDrive]]:
    """Plan all sets by name: POPULATION-fit, -calibration, -test and -oracle-SEED, and the names of other sets."""
    populations, oracle = study.populations, study.oracle
    sets = {
        f"{name}-{part}": plan_drives(getattr(population, part), population.factors)
        for name, population in populations.items()
        for part in PARTS
    }
    for name, drives in study.others.items():
        sets[name] = plan_drives(drives, populations[drives.like].factors if drives.like else {})
    for name, population in populations.items():
        for k, seed in enumerate(oracle.paths):
            changes = {
                "runs": oracle.drives,
                "draw_seed": oracle.draw_seed + k,
                "first_robot": oracle.first_robot + k * oracle.drives,
                "factors": {"seed": {"each": oracle.first_seed + k * oracle.drives}},
            }
            runs = plan_drives(population.test.model_copy(update=changes), population.factors)
            sets[f"{name}-oracle-{seed}"] = [replace(run, path=seed) for run in runs]
    return sets


def plan_drives(drives: DriveSet, factors: Mapping[str, object]) -> list[PlannedDrive]:
    """Plan the drives of a set; raises ConfigError for invalid factors, as a campaign."""
    campaign = Campaign(
        description="a set", runs=drives.runs, draw_seed=drives.draw_seed, factors={**factors, **drives.factors}
    )
    definitions = campaign.definitions()
    if drives.robots is not None:
        count = drives.first_robot + drives.runs
        seeds = driving_seeds(count, spot_turns=True, tuning=drives.robots == "tuning")[drives.first_robot :]
        definitions = [
            definition.with_factors({"plant": f"{DRAWN}:{seed}"})
            for definition, seed in zip(definitions, seeds, strict=True)
        ]
    first = drives.first_path
    return [PlannedDrive(definition, None if first is None else first + k) for k, definition in enumerate(definitions)]


def drive(study: PredictedErrorFile, planned_drive: PlannedDrive) -> DrivenPath:
    """Simulate a drive and return its errors and features; raises StudyFailedError for a lag out of range."""
    with built(planned_drive.definition) as (controller, plant, reference):
        assert isinstance(controller, Controller)
        lags = controller.model.lag
        for value, (low, high) in zip(lags, (study.lag_v, study.lag_omega), strict=True):
            if not low <= value <= high:
                raise StudyFailedError(f"lags of a model: {lags} s; widen lag_v or lag_omega of the study")
        if planned_drive.path is not None:
            reference = study.path(planned_drive.path)  # noqa: PLW2901 - the path of the run is not driven
        run = simulate(controller, plant, reference)
        on_path = run.time <= reference.duration + 1e-9
        offset = run.true_pose[on_path] - run.reference_pose[on_path]
        along, _ = ahead_and_left(offset, run.reference_pose[on_path, 2])
        errors = {"lateral": run.errors.lateral[on_path], "along": along}
        twist = reference.sample(np.arange(int(reference.duration / run.sample_time) + 1) * run.sample_time).twist
        return summarise_drive(twist, errors, controller, run.sample_time, _friction(planned_drive.definition))


def summarise_drive(
    twist: FloatArray, errors: Mapping[str, FloatArray], controller: Controller, dt: float, friction: float
) -> DrivenPath:
    """Reduce the errors of a drive to places, and add the features of its reference with `twist` (m, 2)."""
    count = len(twist) // TICKS_PER_PLACE
    features = path_features(twist, dt, controller.config, controller.model.lag)
    return DrivenPath(
        features[: count * TICKS_PER_PLACE].reshape(count, TICKS_PER_PLACE, len(FEATURES)).mean(axis=1),
        {name: _max_by_place(np.abs(values), count) for name, values in errors.items()},
        float(np.abs(twist[:, 0]).mean()),
        friction,
    )


def _max_by_place(values: FloatArray, count: int) -> FloatArray:
    """Return the maximum (count,) of the values at each place; infinite after the end of the drive."""
    padded = np.full(count * TICKS_PER_PLACE, np.inf)
    available = values[: len(padded)]
    padded[: len(available)] = np.where(np.isfinite(available), available, np.inf)
    return np.asarray(padded.reshape(count, TICKS_PER_PLACE).max(axis=1))


def _friction(definition: Definition) -> float:
    drawn = drawn_robot(definition.case.plant)
    if drawn is not None:
        return float(drawn.build.friction or np.nan)
    value = dict(definition.surface).get("friction")
    return float(value) if isinstance(value, (int, float)) else np.nan


def write_drives(driven: Sequence[DrivenPath], file: Path) -> None:
    """Write the data of a set of drives as float32."""
    arrays = {
        f"{k}-{name}": values
        for k, path in enumerate(driven)
        for name, values in (("features", path.features), *path.errors.items(), ("of", [path.speed, path.friction]))
    }
    packed: dict[str, Any] = {name: np.asarray(values, dtype=np.float32) for name, values in arrays.items()}
    np.savez_compressed(file, **packed)


def read_drives(file: Path) -> list[DrivenPath]:
    """Read the data of a set of drives."""
    with np.load(file) as arrays:
        count = sum(name.endswith("-of") for name in arrays.files)
        return [
            DrivenPath(
                arrays[f"{k}-features"].astype(float),
                {name: arrays[f"{k}-{name}"].astype(float) for name in ("lateral", "along")},
                *arrays[f"{k}-of"].astype(float).tolist(),
            )
            for k in range(count)
        ]
