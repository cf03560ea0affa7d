"""The papers' figures, read from `published.yaml`, each with its paper and table there; and findings put as rules."""

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

Four = tuple[float, float, float, float]
"""RMSE, mean, standard deviation and maximum."""


class PublishedErrors(StrictModel):
    """Open-loop odometry errors."""

    position: Four
    heading: Four


class PublishedFit(StrictModel):
    """FIT [%] and RMSE [m/s, rad/s] of a velocity prediction."""

    fit_percent: ChannelFit
    rmse: ChannelFit

    @property
    def values(self) -> list[float]:
        """FIT of v and omega, RMSE of v and omega."""
        return [self.fit_percent.v, self.fit_percent.omega, self.rmse.v, self.rmse.omega]


class PublishedDrive(PublishedFit):
    """A free drive: velocity and odometry."""

    odometry: PublishedErrors


class PublishedNetwork(StrictModel):
    """One row of P1's Table 2."""

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
    """Mean and standard deviation over runs."""

    simulation_time: tuple[float, float]
    time_per_step: tuple[float, float]
    memory: tuple[float, float]


class PublishedTrack(StrictModel):
    """Virtual track over yaw rate."""

    p1: float
    p0: float
    tests: list[tuple[float, float]]
    radii: list[tuple[float, float]]
    exchanged: list[tuple[int, int]]


class PublishedDriveErrors(StrictModel):
    """Mean and largest error of v [mm/s] and of omega [degrees per second]."""

    v: tuple[float, float]
    omega: tuple[float, float]


class FindingThresholds(StrictModel):
    """Thresholds that decide findings."""

    worthwhile_fit_percent: float
    good_fit_percent: float
    quicker: float
    much_quicker: float
    certain: float
    told_apart_fit_percent: float
    chance: float


class Published(StrictModel):
    """Everything that the reproduction is held against; keys and units as in `published.yaml`."""

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
    """Read the file; raises ConfigError on a mistake in it."""
    return load_checked(Published, Path(__file__).parent / "published.yaml")


@dataclass(frozen=True)
class PaperFinding:
    """A finding of a paper, put as a rule.

    Attributes
    ----------
    claim
        The rule, as a sentence that is true or not.
    source
        Paper of the value and place in it.
    published, plant
        The numbers behind it, in the paper and on the simulated robot (means over repetitions).
    holds
        For each repetition, whether the rule holds there; empty where the numbers do not decide it.
    """

    claim: str
    source: str
    published: str
    plant: str
    holds: tuple[bool, ...]

    @property
    def verdict(self) -> str:
        """Yes, no, in how many repetitions, or inconclusive."""
        if not self.holds:
            return "inconclusive"
        if all(self.holds):
            return "yes"
        return f"{sum(self.holds)} of {len(self.holds)}" if any(self.holds) else "no"


def each(flags: ArrayLike) -> tuple[bool, ...]:
    """Convert flags (repetitions,) to plain truth values."""
    return tuple(bool(flag) for flag in np.atleast_1d(flags))


# Experiments of `reproduce`, read from `study.yaml` or, for a quick one, from `quick.yaml`.


PARTS = ("mbm_sm", "ssm", "lstm", "cost", "virtual_track", "drive_models")
"""Names of the parts, in the order of the report."""

Count = Annotated[int, Field(ge=1)]


class MbmSmStudy(StrictModel):
    """MBM and SM from steps, held against each other on trajectories."""

    trajectories: Annotated[tuple[str, ...], Field(min_length=1)]
    free_drives: Count
    free_duration: Positive = Field(description="[s]")


class PaperRange(StrictModel):
    """Speed range of the set-points of the paper's free drives."""

    v: Positive = Field(description="[m/s]")
    omega: Positive = Field(description="[rad/s]")


class SsmStudy(StrictModel):
    """SSM of several orders from one free drive."""

    train_duration: Positive = Field(description="[s]")
    largest_order: int = Field(ge=2, le=5)
    test_drives: Count
    free_drives: Count
    free_duration: Positive = Field(description="[s]")
    paper_range: PaperRange


class LongerTraining(StrictModel):
    """Differences of a training from the paper's."""

    dropout: float = Field(ge=0, lt=1)
    decay: float = Field(ge=0)
    patience: Count
    most_epochs: Count


class NetworkStudy(StrictModel):
    """LSTM and SSM from one free drive, and networks of Table 2."""

    train_duration: Positive = Field(description="[s]")
    free_drives: Count
    free_duration: Positive = Field(description="[s]")
    paper_range: PaperRange
    rows: tuple[tuple[int, ...], ...] = Field(description="of Table 2, in groups that are trained one after the other")
    longer: LongerTraining


class CostStudy(StrictModel):
    """Simulations that are timed."""

    runs: int = Field(ge=2, description="a spread takes two")
    steps: Count
    simulation_steps: dict[str, Count] = Field(description="of the whole simulations, by model")


class DriveStudy(StrictModel):
    """Drive models on drives with changes of direction, and on logs."""

    drives: Count = Field(description="to fit, and as many held out")
    duration: Positive = Field(description="of each [s]")
    v: Positive = Field(description="largest set-point [m/s]")
    omega: Positive = Field(description="largest set-point [rad/s]")
    repetitions: Count = Field(description="how many of the repetitions")
    logs: tuple[str, ...] = Field(description="of real_logs.yaml")


class TrackStudy(StrictModel):
    """P3's tests driven, and drives in which one thing stays."""

    surfaces: Annotated[tuple[str, ...], Field(min_length=1)]
    tests: Annotated[tuple[tuple[Positive, Positive], ...], Field(min_length=3)] = Field(
        description="v [m/s], yaw rate [rad/s]"
    )
    duration: Positive = Field(description="of a drive [s]")
    settling: Positive = Field(description="of it that does not count [s]")
    v: Positive = Field(description="that stays [m/s]")
    yaw_rate: Positive = Field(description="that stays [rad/s]")
    yaw_rates: Annotated[tuple[Positive, ...], Field(min_length=3)] = Field(description="[rad/s]")
    speeds: Annotated[tuple[Positive, ...], Field(min_length=3)] = Field(description="[m/s]")


class ReproduceSettings(StrictModel):
    """All parts; a repetition has its own drives and noise."""

    repetitions: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]
    mbm_sm: MbmSmStudy
    ssm: SsmStudy
    lstm: NetworkStudy
    cost: CostStudy
    drive_models: DriveStudy
    driven_track: TrackStudy


def load_study(*, quick: bool = False) -> ReproduceSettings:
    """Read the study; raises ConfigError when its file has a mistake."""
    return load_checked(ReproduceSettings, Path(__file__).parent / ("quick.yaml" if quick else "study.yaml"))
