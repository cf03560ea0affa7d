"""Which logs there are and how they are scored: read from `protocol.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


class Stated(StrictModel):
    """Figures that stand beside a log."""

    fit_percent: tuple[float | None, float | None, float | None] = Field(
        description="v, omega of encoders, of gyro [%]"
    )
    position: tuple[Positive, ...] = Field(default=(), description="open-loop error at the horizons [m]")
    heading: tuple[Positive, ...] = Field(default=(), description="open-loop error at the horizons [rad]")


class RealLog(StrictModel):
    """One log of a real robot."""

    robot: str
    file: str = Field(description="inside the folder of the data")
    mapping: str
    stated: Stated


class Protocol(StrictModel):
    """How all of them are divided and scored."""

    share: Annotated[float, Field(gt=0, lt=1)] = Field(description="of the rows, to fit [-]")
    horizons: tuple[Positive, ...] = Field(description="of the open-loop pose error [s]")
    logs: dict[str, RealLog]

    def log(self, name: str) -> RealLog:
        """One log; raises ConfigError where there is none of that name."""
        if name not in self.logs:
            raise ConfigError(f"unknown log '{name}': give one of {', '.join(self.logs)}")
        return self.logs[name]


@cache
def load_protocol() -> Protocol:
    """Read `protocol.yaml`; raises ConfigError on a mistake in it."""
    return load_checked(Protocol, Path(__file__).with_name("protocol.yaml"))
