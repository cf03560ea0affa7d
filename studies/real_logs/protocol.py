"""Logs of real robots: which there are, and each identified from its first rows and scored on the others.

Each stretch is simulated once from its commands, from its first readings on, and never restarted; FIT is pooled over
stretches. Pose errors start every second inside one stretch, about the centre of rotation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.base_effects import PoseMount
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.identification.effects import IdentifiedBase
from diffdrive_mpc.models.identification.fit.poses import PoseDrift, pose_drift
from diffdrive_mpc.models.identification.from_logs import Identification, identify_data
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Record, read_log
from diffdrive_mpc.models.output_error.validation import simulate_records, validate
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.structures.sm import identify_sm

_FEWEST_READINGS = 20


class StatedFigures(StrictModel):
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
    stated: StatedFigures


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


@dataclass(frozen=True)
class ModelScore:
    """How well one model explains the rows that it was not made from.

    Attributes
    ----------
    model
        Its name.
    fit_percent
        (3,) FIT of v and omega of the encoders, of omega of the gyro [%]; NaN where nothing is stated.
    drift
        Open-loop pose errors, one for each horizon; empty without poses.
    """

    model: str
    fit_percent: FloatArray
    drift: tuple[PoseDrift, ...]


@dataclass(frozen=True)
class LogProof:
    """What came of one log.

    Attributes
    ----------
    log
        Which.
    scores
        Linear model and model with effects.
    found
        The model with effects, its configuration and report.
    """

    log: RealLog
    scores: tuple[ModelScore, ...]
    found: Identification

    @property
    def base(self) -> IdentifiedBase:
        """The model with effects, and the sensors that it was seen through."""
        base = self.found.report.fitted.base
        assert base is not None
        return base


def prove(log: RealLog, data: Path, on_progress: Callable[[str], None] | None = None) -> LogProof:
    """Identify and score, as `protocol.yaml` says.

    Parameters
    ----------
    log
        Which log.
    data
        The folder of the data.
    on_progress
        Called with what is done next.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError
        If the log is not there or cannot be used.
    """
    read = read_log(data / log.file, log.mapping)
    read.require_sound()
    share = load_protocol().share
    train, held_out = map(tuple, divide(read.records, share))
    records = LogData(
        train=train,
        validation=held_out,
        logs=(f"{log.robot}; {Path(log.file).name}",),
        held_out=f"the last {100 * (1 - share):.0f} % of the rows",
        yaw="gyro",
        findings=read.findings,
        warnings=(),
    )
    name = log.robot.partition(",")[0]
    identification = identify_data(records, STRUCTURES["sm"], name, effects=True, on_progress=on_progress)
    proof = LogProof(log, (), identification)
    linear = identify_sm(train)
    return replace(
        proof, scores=(_linear_score(linear, train, held_out, proof.base), _base_score(proof.base, held_out))
    )


def divide(records: Sequence[Record], share: float) -> tuple[list[Record], list[Record]]:
    """The first `share` [-] of the rows of a log, and the rest; a row is a sample with a gyro reading of its own.

    Parts with fewer than 20 readings of a sensor are left out.
    """
    rows = [np.asarray(record.fresh_yaw_rate) for record in records]
    left = round(share * sum(int(row.sum()) for row in rows))
    first: list[Record] = []
    last: list[Record] = []
    for record, row in zip(records, rows, strict=True):
        count = len(row)
        cut = (
            count if left >= row.sum() else int(np.searchsorted(np.cumsum(row), left, side="right")) if left > 0 else 0
        )
        left -= int(row.sum())
        for begin, end, into in ((0, cut, first), (cut, count, last)):
            if end > begin and _readings(part := record.part(begin, end)) >= _FEWEST_READINGS:
                into.append(part)
    return first, last


def _readings(record: Record) -> int:
    """Of the sensor that has fewest."""
    return min(int(np.sum(mask)) for mask in (record.fresh_twist, record.fresh_yaw_rate) if mask is not None)


def _linear_score(
    linear: IdentifiedModel, train: Sequence[Record], held_out: Sequence[Record], base: IdentifiedBase
) -> ModelScore:
    """SM without effects, one of each yaw rate; poses about the same centre, with the lever arm alone."""
    wheels = identify_sm(train, yaw="encoders")
    fit = validate(linear.system, held_out).fit_percent
    by_wheels = validate(wheels.system, held_out, "encoders").fit_percent
    travel = base.pose.value("pose.travel") if base.pose else 1.0
    twists = [(twist - linear.offset) * np.array([travel, 1.0]) for twist in simulate_records(linear.system, held_out)]
    ahead = PoseMount(ahead=base.pose.value("mount.ahead")) if base.pose else None
    return ModelScore("linear", np.array([fit[0], by_wheels[1], fit[1]]), _drift(held_out, twists, ahead, base))


def _base_score(base: IdentifiedBase, held_out: Sequence[Record]) -> ModelScore:
    mount = None
    if base.pose:
        mount = PoseMount(**{name: base.pose.value(f"mount.{name}") for name in ("ahead", "left", "heading")})
    drift = _drift(held_out, base.body_twists(held_out), mount, base)
    return ModelScore("with effects", base.fit_percent(held_out), drift)


def _drift(
    records: Sequence[Record], twists: Sequence[FloatArray], mount: PoseMount | None, base: IdentifiedBase
) -> tuple[PoseDrift, ...]:
    if mount is None or base.pose is None:
        return ()
    centred = [replace(record, pose=mount.centre(record.pose)) for record in records if record.pose is not None]
    lag = base.pose.value("pose.delay")
    return tuple(pose_drift(centred, twists, pose_lag=lag, horizons=load_protocol().horizons))
