"""The papers' figures, read from `published.yaml`, each with its paper and table there."""

from __future__ import annotations

from functools import cache
from pathlib import Path

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


class PublishedDrive(PublishedFit):
    """A free drive: velocity and odometry."""

    odometry: PublishedErrors


class PublishedCost(StrictModel):
    """Mean and standard deviation over runs."""

    time_per_step: tuple[float, float]
    memory: tuple[float, float]


class PublishedTrack(StrictModel):
    """Virtual track over yaw rate."""

    p1: float
    p0: float
    tests: list[tuple[float, float]]
    exchanged: list[tuple[int, int]]


class Rules(StrictModel):
    """Thresholds that decide findings."""

    worthwhile_fit_percent: float
    good_fit_percent: float
    quicker: float
    much_quicker: float
    certain: float


class Published(StrictModel):
    """Everything that the reproduction is held against; keys and units as in `published.yaml`."""

    motor_fit_percent: float
    sm_fit_percent: ChannelFit
    odometry: dict[str, dict[str, PublishedErrors]]
    orders: dict[int, PublishedFit]
    free_drives: list[PublishedDrive]
    cost: dict[str, PublishedCost]
    virtual_track: PublishedTrack
    rules: Rules


@cache
def load_published() -> Published:
    """Read the file; raises ConfigError on a mistake in it."""
    return load_checked(Published, Path(__file__).parent / "published.yaml")
