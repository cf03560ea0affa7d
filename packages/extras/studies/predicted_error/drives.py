"""Drives of the study: drawn, driven and stored."""

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
_QUICK = 20
"""With fewer drives no bound holds for 95 % of them."""
THINNED = 5
"""Ticks that become one place: the largest |error| of them."""
_DRAWN_FROM = 37


class DriveSet(StrictModel):
    """Drives that are drawn alike."""

    runs: Count = Field(description="how many")
    draw_seed: int = Field(0, ge=0, description="of the factors")
    robots: Literal["tuning", "reserved"] | None = Field(None, description="robots of the market; null: as factors say")
    first_robot: int = Field(0, ge=0, description="the first one's number among those that can drive")
    first_path: int | None = Field(None, ge=0, description="seed of the first random path; null: as factors say")
    like: str | None = Field(None, description="population whose factors are taken, too")
    factors: dict[str, object] = Field(default_factory=dict, description="as in a campaign")


class PopulationDrives(StrictModel):
    """A population, and the sets that are drawn from it."""

    description: str = Field(min_length=1, description="which robots and floors")
    factors: dict[str, object] = Field(default_factory=dict, description="of all sets")
    fit: DriveSet = Field(description="for the coefficients")
    calibration: DriveSet = Field(description="for the quantiles")
    test: DriveSet = Field(description="for coverage; robots, paths and seeds that played no part before")


class Oracle(StrictModel):
    """Paths that are driven often, to know their tubes."""

    drives: Count = Field(description="of each path")
    first_robot: int = Field(0, ge=0, description="number of the first reserved robot")
    first_seed: int = Field(0, ge=0, description="seed of the first drive's noise")
    draw_seed: int = Field(0, ge=0, description="of the factors on the first path")
    paths: tuple[int, ...] = Field(description="seeds of random paths")


class PredictedErrorFile(StrictModel):
    """Drives of the study."""

    level: float = Field(gt=0.5, lt=1.0, description="share of drives inside a tube [-]")
    speed: CalibratedRange = Field(description="top speed of a path [m/s]")
    yaw_rate: CalibratedRange = Field(description="top yaw rate of a path [rad/s]")
    acceleration: Span = Field(description="over the usual accelerations of references [-]")
    lag_v: CalibratedRange = Field(description="lag of v of the models, dead time included [s]")
    lag_omega: CalibratedRange = Field(description="lag of omega of the models, dead time included [s]")
    populations: dict[str, PopulationDrives] = Field(description="what is calibrated")
    others: dict[str, DriveSet] = Field(default_factory=dict, description="what nothing was calibrated on")
    oracle: Oracle = Field(Oracle(drives=1, paths=()), description="what an oracle drives")

    @property
    def calibrated(self) -> CalibratedRanges:
        """For which paths and models the tubes are to hold."""
        return CalibratedRanges(v=self.speed, omega=self.yaw_rate, lag_v=self.lag_v, lag_omega=self.lag_omega)

    def path(self, seed: int) -> Trajectory:
        """Return the random path of a seed, timed with limits drawn from it."""
        stream = np.random.default_rng([seed, _DRAWN_FROM])
        spans = (self.speed, self.yaw_rate, self.acceleration)
        speed, yaw_rate, share = (float(np.exp(stream.uniform(*np.log(span)))) for span in spans)
        usual = TrajectoryLimits.of_robot()
        limits = replace(
            usual,
            v=speed,
            omega=yaw_rate,
            v_acceleration=share * usual.v_acceleration,
            omega_acceleration=share * usual.omega_acceleration,
            lateral_acceleration=share * usual.lateral_acceleration,
        )
        return load_trajectory(f"spline-{seed}", limits)


@dataclass(frozen=True)
class PlannedDrive:
    """A run, and the seed of its random path; without one it is the path of the run."""

    definition: Definition
    path: int | None


@dataclass(frozen=True)
class DrivenPath:
    """Data of a drive, at n places.

    Attributes
    ----------
    features
        (n, len(FEATURES)) of path and configuration.
    errors
        By direction |error| (n,) [m]; infinite from where the drive ended early.
    speed
        Mean speed of the reference [m/s].
    friction
        Of the floor; NaN where the plant has none.
    """

    features: FloatArray
    errors: Mapping[str, FloatArray]
    speed: float
    friction: float


def load_study(path: Path | None, *, quick: bool = False) -> PredictedErrorFile:
    """Read the study, by default the shipped one; a quick one has few drives. Raises ConfigError on a mistake."""
    study = load_checked(PredictedErrorFile, path or Path(__file__).with_name("study.yaml"))
    if not quick:
        return study
    name, first = next(iter(study.populations.items()))
    sets = {part: getattr(first, part).model_copy(update={"runs": _QUICK}) for part in PARTS}
    return study.model_copy(
        update={
            "populations": {name: first.model_copy(update=sets)},
            "others": {"dropouts": study.others["dropouts"].model_copy(update={"runs": 2})},
            "oracle": study.oracle.model_copy(update={"drives": 5}),
        }
    )


def planned_sets(study: PredictedErrorFile) -> dict[str, list[PlannedDrive]]:
    """Plan all sets by name: POPULATION-fit, -calibration, -test, -oracle-SEED, and the others."""
    populations, oracle = study.populations, study.oracle
    sets = {
        f"{name}-{part}": planned(getattr(population, part), population.factors)
        for name, population in populations.items()
        for part in PARTS
    }
    for name, drives in study.others.items():
        sets[name] = planned(drives, populations[drives.like].factors if drives.like else {})
    for name, population in populations.items():
        for k, seed in enumerate(oracle.paths):
            changes = {
                "runs": oracle.drives,
                "draw_seed": oracle.draw_seed + k,
                "first_robot": oracle.first_robot + k * oracle.drives,
                "factors": {"seed": {"each": oracle.first_seed + k * oracle.drives}},
            }
            driven = planned(population.test.model_copy(update=changes), population.factors)
            sets[f"{name}-oracle-{seed}"] = [replace(run, path=seed) for run in driven]
    return sets


def planned(drives: DriveSet, factors: Mapping[str, object]) -> list[PlannedDrive]:
    """Plan the drives of a set; raise ConfigError as a campaign does."""
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
    """Drive, and keep errors and features."""
    with built(planned_drive.definition) as (controller, plant, reference):
        assert isinstance(controller, Controller)
        lags = controller.model.lag
        for value, (low, high) in zip(lags, (study.lag_v, study.lag_omega), strict=True):
            if not low <= value <= high:
                raise StudyFailedError(f"lags of a model: {lags} s; let lag_v and lag_omega of the study hold them")
        if planned_drive.path is not None:
            reference = study.path(planned_drive.path)  # noqa: PLW2901 - the path of the run is not driven
        run = simulate(controller, plant, reference)
        on_path = run.time <= reference.duration + 1e-9
        beside = run.true_pose[on_path] - run.reference_pose[on_path]
        along, _ = ahead_and_left(beside, run.reference_pose[on_path, 2])
        errors = {"lateral": run.errors.lateral[on_path], "along": along}
        twist = reference.sample(np.arange(int(reference.duration / run.sample_time) + 1) * run.sample_time).twist
        return thinned(twist, errors, controller, run.sample_time, _friction(planned_drive.definition))


def thinned(
    twist: FloatArray, errors: Mapping[str, FloatArray], controller: Controller, dt: float, friction: float
) -> DrivenPath:
    """Thin the errors of a drive, and add the features of its reference, whose twist is (m, 2)."""
    count = len(twist) // THINNED
    features = path_features(twist, dt, controller.config, controller.model.lag)
    return DrivenPath(
        features[: count * THINNED].reshape(count, THINNED, len(FEATURES)).mean(axis=1),
        {name: _largest(np.abs(values), count) for name, values in errors.items()},
        float(np.abs(twist[:, 0]).mean()),
        friction,
    )


def _largest(values: FloatArray, count: int) -> FloatArray:
    """Return the largest of each `THINNED` values, infinite where a drive has ended."""
    whole = np.full(count * THINNED, np.inf)
    some = values[: len(whole)]
    whole[: len(some)] = np.where(np.isfinite(some), some, np.inf)
    return np.asarray(whole.reshape(count, THINNED).max(axis=1))


def _friction(definition: Definition) -> float:
    drawn = drawn_robot(definition.case.plant)
    if drawn is not None:
        return float(drawn.build.friction or np.nan)
    value = dict(definition.surface).get("friction")
    return float(value) if isinstance(value, (int, float)) else np.nan


def keep(driven: Sequence[DrivenPath], file: Path) -> None:
    """Write a set that was driven."""
    arrays = {
        f"{k}-{name}": values
        for k, path in enumerate(driven)
        for name, values in (("features", path.features), *path.errors.items(), ("of", [path.speed, path.friction]))
    }
    packed: dict[str, Any] = {name: np.asarray(values, dtype=np.float32) for name, values in arrays.items()}
    np.savez_compressed(file, **packed)


def read_kept(file: Path) -> list[DrivenPath]:
    """Read a set that was driven."""
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
