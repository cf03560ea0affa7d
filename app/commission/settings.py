"""What a commissioning drives and demands; the numbers stand in `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import NotNegative, Positive


class DriveSettings(StrictModel):
    """A drive to identify from."""

    seconds: Positive
    speed: Positive
    yaw_rate: Positive


class Gates(StrictModel):
    """What a step must reach."""

    delay_deviation: Positive
    gain_deviation: Positive
    fit: float
    twin_behind: NotNegative
    lateral_share: Positive


class ProofSettings(StrictModel):
    """The runs of the proof."""

    runs: int = Field(ge=1)
    first_seed: int = Field(ge=0)
    worst: int = Field(ge=0, le=99)
    spread: dict[str, tuple[Positive, Positive]]


class QuickSettings(StrictModel):
    """The short form: seconds of the drives and of the log that the twin is fitted to, runs of the proof."""

    slow: Positive
    full: Positive
    twin: Positive
    runs: int = Field(ge=1)


class MostSlip(StrictModel):
    """Of what a log may say of sideways slip."""

    side_slip: Positive
    load_shift: Positive


class CommissionSettings(StrictModel):
    """All of it."""

    slow: DriveSettings
    full: DriveSettings
    twin_seconds: Positive
    most_slip: MostSlip
    quick: QuickSettings
    gates: Gates
    proof: ProofSettings


@cache
def commission_settings() -> CommissionSettings:
    """Read the settings; raises ConfigError on a mistake in them."""
    return load_checked(CommissionSettings, Path(__file__).with_suffix(".yaml"))
