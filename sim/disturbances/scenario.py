"""Scenarios: named sets of disturbances, with values drawn from the seed of the run."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, check
from diffdrive_mpc.models.named_file import EntryFile
from diffdrive_mpc.sim.disturbances.disturbance_types import (
    BatterySag,
    Blockade,
    DeadEncoders,
    DropOut,
    FalseCommand,
    GyroBias,
    Patch,
    Payload,
    PoseError,
    Push,
    SlippingWheel,
    Slope,
    Span,
    StartOffset,
    StuckSensor,
    WeakMotor,
    Window,
)
from diffdrive_mpc.sim.disturbances.drawn_values import check_random_values, draw_values, extremes

SCENARIOS = EntryFile("scenario", Path(__file__).with_name("scenarios.yaml"))
_SENSOR_FAULTS = ("drop_outs", "stuck_sensors", "dead_encoders", "gyro_biases", "pose_errors")
_ANY_PLANT = ("start_offset", "false_commands", *_SENSOR_FAULTS)

# Spawn key of the random stream; sensors and encoders use 0, 1, 2 and 1000, so a scenario does not change the noise.
# With this key, seeds 0 to 3 draw all four sign combinations of the start offset, and both signs of false command and
# push.
_SPAWN_KEY = 2_080


class Scenario(StrictModel):
    """Disturbances of a run with drawn values."""

    description: str = Field(min_length=1, description="description in one line")
    start_offset: StartOffset | None = None
    patches: tuple[Patch, ...] = ()
    payload: Payload | None = None
    slope: Slope | None = None
    weak_motors: tuple[WeakMotor, ...] = ()
    slipping_wheels: tuple[SlippingWheel, ...] = ()
    battery: BatterySag | None = None
    drop_outs: tuple[DropOut, ...] = ()
    stuck_sensors: tuple[StuckSensor, ...] = ()
    dead_encoders: tuple[DeadEncoders, ...] = ()
    gyro_biases: tuple[GyroBias, ...] = ()
    pose_errors: tuple[PoseError, ...] = ()
    false_commands: tuple[FalseCommand, ...] = ()
    pushes: tuple[Push, ...] = ()
    blockades: tuple[Blockade, ...] = ()

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the fields that contain disturbances."""
        return tuple(name for name in type(self).model_fields if name != "description" and getattr(self, name))

    @property
    def physical(self) -> tuple[str, ...]:
        """Names in `kinds` of disturbances that require a plant in the physics; all plants support the other kinds."""
        return tuple(name for name in self.kinds if name not in _ANY_PLANT)

    @property
    def spans(self) -> tuple[Span, ...]:
        """Start and end [s] of every disturbance except patches, whose times depend on the motion."""
        disturbances: Iterable[Window | BatterySag] = (
            *self.weak_motors,
            *self.slipping_wheels,
            *([self.battery] if self.battery else ()),
            *(fault for name in _SENSOR_FAULTS for fault in getattr(self, name)),
            *self.false_commands,
            *self.pushes,
            *self.blockades,
        )
        spans = [item.span for item in disturbances]
        if self.start_offset:
            spans.append((0.0, 0.0))
        if self.payload or self.slope:
            spans.append((0.0, math.inf))
        return tuple(spans)


@dataclass(frozen=True)
class ScenarioFile:
    """Checked content of a scenario file, with ranges and choices from which `draw` draws values.

    Attributes
    ----------
    data
        Values by key.
    where
        File, or entry of a built-in scenario, for messages.
    """

    data: Any
    where: str

    def draw(self, seed: int) -> Scenario:
        """Draw the scenario of the run with the non-negative `seed`; the result depends only on the seed."""
        stream = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_SPAWN_KEY,)))
        return check(Scenario, draw_values(self.data, stream), self.where)


def combine(scenario: Scenario, second: Scenario) -> Scenario:
    """Combine two scenarios; for kinds that can occur only once, `scenario` takes precedence."""
    combined = {
        name: value + getattr(scenario, name) if isinstance(value, tuple) else getattr(scenario, name) or value
        for name in second.kinds
        for value in [getattr(second, name)]
    }
    return scenario.model_copy(update=combined)


def load_scenario(name: str | Path) -> ScenarioFile:
    """Read a scenario by built-in name or path.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the scenario does not exist, its file is invalid, or a random value may be out of range.
    """
    data, where = SCENARIOS.read(name)
    check_random_values(data, where)
    for values in extremes(data):
        check(Scenario, values, where)
    return ScenarioFile(data, where)
