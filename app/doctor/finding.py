"""What one look found."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive

Status = Literal["ok", "warn", "missing", "unknown"]


@dataclass(frozen=True)
class Finding:
    """One row of the table.

    Attributes
    ----------
    what
        What was looked at.
    status
        "ok"; "warn", it costs something; "missing"; "unknown", it could not be seen, as often in a container.
    found
        What there is.
    means
        What that means, and what to do about it.
    needed
        Whether the controller cannot run while this is missing.
    """

    what: str
    status: Status
    found: str
    means: str
    needed: bool = False


class DoctorSettings(StrictModel):
    """What is called enough; units stand in the file."""

    jitter_period: Positive
    jitter_time: Positive
    most_lateness: Positive
    least_memory: Positive
    least_disk: Positive
    least_shared_memory: Positive
    least_rtprio: Positive


@cache
def doctor_settings() -> DoctorSettings:
    """Read `settings.yaml`; raises ConfigError when it has a mistake."""
    return load_checked(DoctorSettings, Path(__file__).with_name("settings.yaml"))


def in_bytes(number: float) -> str:
    """A number of bytes in a unit that is read easily."""
    return f"{number / 1e9:.1f} GB" if number >= 1e9 else f"{number / 1e6:.0f} MB"
