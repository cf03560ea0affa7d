"""The papers' figures, read from `published.yaml`, each with its paper and table there; and findings put as rules."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
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


class PublishedLeastRadius(StrictModel):
    """By the raw torques, and of the network [m]."""

    raw: float
    network: float


class PublishedEnergyMissed(StrictModel):
    """Measured less foreseen energy [%], with learning and by the prior."""

    learned: float
    prior: float


class PublishedLearningCost(StrictModel):
    """Time of one iteration, or of a plan [s]."""

    mran: float
    ipem: float
    sbmpo: float


class PublishedTurning(StrictModel):
    """P4's turns: regimes of the inner side [m], least radii, energies and times."""

    inner_forward_from: float
    inner_drives_beyond: float
    least_radius: dict[str, PublishedLeastRadius]
    energy_missed: dict[str, PublishedEnergyMissed]
    cost: PublishedLearningCost


class Rules(StrictModel):
    """Thresholds that decide findings."""

    worthwhile_fit_percent: float
    good_fit_percent: float
    quicker: float
    much_quicker: float
    certain: float
    told_apart_fit_percent: float
    chance: float
    corresponds: float
    inside: tuple[float, float]
    turn_radius_off: float
    turn_rise: float
    turn_crossing: float
    turn_alike: float
    turn_alike_from: float
    turn_torque_off: float
    turn_least_radius_off: float


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
    turning: PublishedTurning
    rules: Rules


@cache
def load_published() -> Published:
    """Read the file; raises ConfigError on a mistake in it."""
    return load_checked(Published, Path(__file__).parent / "published.yaml")


@dataclass(frozen=True)
class Finding:
    """A finding of a paper, put as a rule.

    Attributes
    ----------
    claim
        The rule, as a sentence that is true or not.
    source
        Whose finding it is, and where it stands.
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
    """Flags (repetitions,) as plain truth values."""
    return tuple(bool(flag) for flag in np.atleast_1d(flags))
