"""Published values from `published.yaml`, findings of the papers as rules, and settings of the study."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.structures.model_file import ChannelFit

Statistics = tuple[float, float, float, float]
"""RMSE, mean, standard deviation and maximum."""


class PublishedErrors(StrictModel):
    """Errors of open-loop odometry in position [m] and heading [rad]."""

    position: Statistics
    heading: Statistics


class PublishedFit(StrictModel):
    """FIT [%] and RMSE [m/s, rad/s] of predicted velocities."""

    fit_percent: ChannelFit
    rmse: ChannelFit

    @property
    def values(self) -> list[float]:
        """FIT of v and omega, RMSE of v and omega."""
        return [self.fit_percent.v, self.fit_percent.omega, self.rmse.v, self.rmse.omega]


class PublishedDrive(PublishedFit):
    """Errors of a model in velocity and odometry on a free drive."""

    odometry: PublishedErrors


class PublishedNetwork(StrictModel):
    """Network of one row of P1's Table 2, and its errors on the test data."""

    window: int
    units: int
    layers: int
    activation: Literal["tanh", "relu"]
    optimiser: Literal["adam", "rmsprop"]
    batch: int
    validation_every: int
    patience: int
    test: PublishedFit


class PublishedCost(StrictModel):
    """Cost of a simulation as (mean, standard deviation) over runs."""

    simulation_time: tuple[float, float]
    time_per_step: tuple[float, float]
    memory: tuple[float, float]


class PublishedTrack(StrictModel):
    """Virtual track as a function of the yaw rate, and the tests of this function; units as in `published.yaml`."""

    p1: float
    p0: float
    tests: list[tuple[float, float]]
    radii: list[tuple[float, float]]
    exchanged: list[tuple[int, int]]


class PublishedDriveErrors(StrictModel):
    """Mean and maximum errors of v [mm/s] and of omega [degrees per second]."""

    v: tuple[float, float]
    omega: tuple[float, float]


class FindingThresholds(StrictModel):
    """Thresholds of the findings; `published.yaml` describes each threshold."""

    worthwhile_fit_percent: float
    good_fit_percent: float
    max_time_ratio: float
    min_speed_ratio: float
    agreement_deviations: float
    significant_fit_percent: float
    max_chance: float


class Published(StrictModel):
    """Published values for the comparison; keys and units as in `published.yaml`."""

    motor_fit_percent: float
    sm_fit_percent: ChannelFit
    odometry: dict[str, dict[str, PublishedErrors]]
    orders: dict[int, PublishedFit]
    free_drives: list[PublishedDrive]
    free_drives_average: PublishedDrive
    lstm_drives: list[PublishedDrive]
    lstm_drives_average: PublishedDrive
    networks: dict[int, PublishedNetwork]
    cost: dict[str, PublishedCost]
    virtual_track: PublishedTrack
    drive_models: dict[str, dict[str, PublishedDriveErrors]]
    rules: FindingThresholds


@cache
def load_published() -> Published:
    """Read `published.yaml`; raise ConfigError if it is invalid."""
    return load_checked(Published, Path(__file__).parent / "published.yaml")


@dataclass(frozen=True)
class PaperFinding:
    """Finding of a paper as a rule.

    Attributes
    ----------
    claim
        Sentence that is true or false.
    source
        Paper with table or section.
    published, plant
        Values of the paper and of the simulated robot (means over repetitions).
    holds
        Flag per repetition, True if the claim holds; empty if the values do not decide the claim.
    """

    claim: str
    source: str
    published: str
    plant: str
    holds: tuple[bool, ...]

    @property
    def verdict(self) -> str:
        """Result as text: "yes", "no", "inconclusive", or the number of repetitions in which the claim holds."""
        if not self.holds:
            return "inconclusive"
        if all(self.holds):
            return "yes"
        return f"{sum(self.holds)} of {len(self.holds)}" if any(self.holds) else "no"


def as_flags(flags: ArrayLike) -> tuple[bool, ...]:
    """Convert flags (repetitions,) of NumPy to Python's."""
    return tuple(bool(flag) for flag in np.atleast_1d(flags))


# Settings of `reproduce`, read from `study.yaml` or, for a quick study, from `quick.yaml`.


PARTS = ("mbm_sm", "ssm", "lstm", "cost", "virtual_track", "drive_models")
"""Names of the parts in the order of the report."""

Count = Annotated[int, Field(ge=1)]


class MbmSmStudy(StrictModel):
    """Comparison of MBM and SM, identified from steps, on trajectories."""

    trajectories: Annotated[tuple[str, ...], Field(min_length=1)]
    free_drives: Count
    free_duration: Positive = Field(description="duration of a free drive [s]")


class PaperRange(StrictModel):
    """Maximum set-points of the paper's free drives."""

    v: Positive = Field(description="maximum forward speed [m/s]")
    omega: Positive = Field(description="maximum yaw rate [rad/s]")


class SsmStudy(StrictModel):
    """SSM of several orders, identified from one free drive."""

    train_duration: Positive = Field(description="duration of the training drive [s]")
    max_order: int = Field(ge=2, le=5)
    test_drives: Count
    free_drives: Count
    free_duration: Positive = Field(description="duration of a free drive [s]")
    paper_range: PaperRange


class LongerTraining(StrictModel):
    """Training settings that differ from those of the paper."""

    dropout: float = Field(ge=0, lt=1)
    decay: float = Field(ge=0)
    patience: Count
    max_epochs: Count


class NetworkStudy(StrictModel):
    """LSTM and SSM, identified from one free drive, and networks of Table 2."""

    train_duration: Positive = Field(description="duration of the training drive [s]")
    free_drives: Count
    free_duration: Positive = Field(description="duration of a free drive [s]")
    paper_range: PaperRange
    rows: tuple[tuple[int, ...], ...] = Field(description="rows of Table 2, in groups that are trained sequentially")
    longer: LongerTraining


class CostStudy(StrictModel):
    """Number and duration of the timed simulations."""

    runs: int = Field(ge=2, description="number of runs; a standard deviation requires at least two")
    steps: Count
    simulation_steps: dict[str, Count] = Field(description="number of steps of a complete simulation by model")


class DriveStudy(StrictModel):
    """Drive models on drives with changes of direction, and on logs."""

    drives: Count = Field(description="number of training drives, and of validation drives")
    duration: Positive = Field(description="duration of a drive [s]")
    v: Positive = Field(description="maximum set-point [m/s]")
    omega: Positive = Field(description="maximum set-point [rad/s]")
    repetitions: Count = Field(description="number of repetitions")
    logs: tuple[str, ...] = Field(description="names of logs in real_logs.yaml")


class TrackStudy(StrictModel):
    """Settings of P3's tests, and of drives with constant speed or constant yaw rate."""

    surfaces: Annotated[tuple[str, ...], Field(min_length=1)]
    tests: Annotated[tuple[tuple[Positive, Positive], ...], Field(min_length=3)] = Field(
        description="v [m/s] and yaw rate [rad/s] of each test"
    )
    duration: Positive = Field(description="duration of a drive [s]")
    settling: Positive = Field(description="initial part of a drive that is not evaluated [s]")
    v: Positive = Field(description="constant speed [m/s]")
    yaw_rate: Positive = Field(description="constant yaw rate [rad/s]")
    yaw_rates: Annotated[tuple[Positive, ...], Field(min_length=3)] = Field(description="varied yaw rates [rad/s]")
    speeds: Annotated[tuple[Positive, ...], Field(min_length=3)] = Field(description="varied speeds [m/s]")


class ReproduceSettings(StrictModel):
    """Settings of all parts; each repetition has different drives and noise."""

    repetitions: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]
    mbm_sm: MbmSmStudy
    ssm: SsmStudy
    lstm: NetworkStudy
    cost: CostStudy
    drive_models: DriveStudy
    driven_track: TrackStudy


def load_study(*, quick: bool = False) -> ReproduceSettings:
    """Read the settings of the study; raise ConfigError if the file is invalid."""
    return load_checked(ReproduceSettings, Path(__file__).parent / ("quick.yaml" if quick else "study.yaml"))
