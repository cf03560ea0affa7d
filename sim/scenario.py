"""What happens to the robot in a run: named disturbances, with values that the run's seed draws.

Frames: forward, left and yaw are the body's, x forward and y left; world is that of the reference. Times count from the
start of the run, and a disturbance without `duration` lasts to its end.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from models.checked_yaml import StrictModel, check, read_yaml
from models.named_file import named_file
from models.robot import Positive
from sim.drawn_values import check_drawn, drawn, extremes
from sim.surface import NotNegative

SCENARIOS = Path(__file__).parent / "scenarios"
Wheel = Literal["front_left", "front_right", "rear_left", "rear_right"]
Fraction = Annotated[float, Field(ge=0, le=1)]
Span = tuple[float, float]
"""When a disturbance began and when the last change of it was over [s]."""

_ANY_PLANT = ("start_offset", "drop_outs", "false_commands")

# Spawn keys of sensors and encoders are 0, 1, 2 and 1000: a scenario changes no noise. Of the keys beyond, this one
# gives the seeds 0 to 3 all four signs of the shipped start offset, and both of false command and push.
_SPAWN_KEY = 2_080


class Window(StrictModel):
    """A stretch of time."""

    start: NotNegative = Field(description="when it begins [s]")
    duration: Positive | None = Field(None, description="how long it lasts [s]; without: to the end of the run")

    @property
    def end(self) -> float:
        """When it ends [s]; infinity for the end of the run."""
        return math.inf if self.duration is None else self.start + self.duration

    @property
    def span(self) -> Span:
        """Begin and last change [s]."""
        return (self.start, self.start if self.duration is None else self.end)

    def holds(self, time: float) -> bool:
        """Whether `time` [s] lies in it, its end excluded."""
        return self.start <= time < self.end

    def share(self, start: float, end: float) -> float:
        """Share of [start, end] [s] that lies in it, 0 to 1."""
        return max(0.0, min(end, self.end) - max(start, self.start)) / (end - start)


class StartOffset(StrictModel):
    """The robot does not start on the reference."""

    along: float = Field(0.0, description="ahead of the reference's start pose [m]")
    across: float = Field(0.0, description="to its left [m]")
    heading: float = Field(0.0, description="turned to the left [rad]")


class Patch(StrictModel):
    """A stretch of the way with other friction."""

    start: NotNegative = Field(description="distance travelled by the robot's middle where it begins [m]")
    length: Positive | None = Field(None, description="along the way [m]; without: to the end of the run")
    friction: Positive = Field(description="sliding friction coefficient there")
    side: Literal["both", "left", "right"] = Field("both", description="wheels that it is under")


class Payload(StrictModel):
    """A ball fixed to the body during the whole run."""

    mass: Positive = Field(description="mass [kg]")
    x: float = Field(0.0, description="ahead of the robot's middle [m]")
    y: float = Field(0.0, description="to its left [m]")
    z: float = Field(0.0, description="above the axles [m]")
    radius: Positive = Field(description="of the ball, for its inertia [m]")


class Slope(StrictModel):
    """A floor that is tilted everywhere."""

    angle: float = Field(ge=0, le=0.6, description="against the horizontal [rad]")
    downhill: float = Field(0.0, description="direction of descent in the world, from the x axis [rad]")


class WeakMotor(Window):
    """A motor that gives only a part of its torque."""

    wheel: Wheel = Field(description="wheel it drives")
    factor: Fraction = Field(description="torque over that of the sound motor")


class SlippingWheel(Window):
    """A wheel that has lost its grip."""

    wheel: Wheel = Field(description="which wheel")
    friction: Positive = Field(description="sliding friction coefficient under it")


class BatterySag(StrictModel):
    """A supply voltage that falls; no-load speed and stall torque fall in proportion."""

    start: NotNegative = Field(description="when it begins to fall [s]")
    duration: Positive = Field(description="how long it falls [s]")
    before: float = Field(1.0, gt=0, le=1, description="voltage over nominal until then")
    after: float = Field(gt=0, le=1, description="voltage over nominal from then on")
    load_drop: float = Field(0.0, ge=0, lt=1, description="further drop with all motors at stall torque, over nominal")

    @property
    def span(self) -> Span:
        """Begin and end of the fall [s]."""
        return (self.start, self.start + self.duration)

    def voltage(self, time: float) -> float:
        """Voltage without load at `time` [s] over nominal."""
        progress = min(1.0, max(0.0, (time - self.start) / self.duration))
        return self.before + progress * (self.after - self.before)


class DropOut(Window):
    """A sensor that delivers nothing."""

    sensor: Literal["pose", "wheels", "gyro"] = Field(description="which sensor")
    duration: Positive = Field(description="how long [s]")


class FalseCommand(Window):
    """The motors get another command than the controller sent, and nothing tells it."""

    v: float = Field(description="forward speed [m/s]")
    omega: float = Field(description="yaw rate [rad/s]")
    duration: Positive = Field(description="how long [s]")


class Push(Window):
    """A force on the body, level with its centre of mass along the floor, that turns with it."""

    force: NotNegative = Field(0.0, description="horizontal force [N]")
    height: NotNegative = Field(description="of the force above the floor [m]")
    direction: float = Field(0.0, description="of the force, from forward to the left [rad]")
    yaw_torque: float = Field(0.0, description="torque to the left about the vertical [N m]")
    duration: Positive = Field(description="how long [s]")


class Blockade(Window):
    """A yielding obstacle holds the body where it was at the start, whatever the wheels do.

    The upper bounds are those of a spring and a damper that the physics step of 2 ms still resolves.
    """

    stiffness: float = Field(gt=0, le=2e4, description="against motion along the floor [N/m]")
    height: NotNegative = Field(description="where it touches the body, above the floor [m]")
    damping: float = Field(gt=0, le=1e3, description="against motion along the floor [N s/m]")
    yaw_stiffness: float = Field(gt=0, le=1e3, description="against turning [N m/rad]")
    yaw_damping: float = Field(gt=0, le=20, description="against turning [N m s/rad]")
    duration: Positive = Field(description="how long [s]")


class Scenario(StrictModel):
    """All disturbances of one run, as numbers."""

    description: str = Field(min_length=1, description="what happens, in one line")
    start_offset: StartOffset | None = None
    patches: tuple[Patch, ...] = ()
    payload: Payload | None = None
    slope: Slope | None = None
    weak_motors: tuple[WeakMotor, ...] = ()
    slipping_wheels: tuple[SlippingWheel, ...] = ()
    battery: BatterySag | None = None
    drop_outs: tuple[DropOut, ...] = ()
    false_commands: tuple[FalseCommand, ...] = ()
    pushes: tuple[Push, ...] = ()
    blockades: tuple[Blockade, ...] = ()

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the fields that hold a disturbance."""
        return tuple(name for name in type(self).model_fields if name != "description" and getattr(self, name))

    @property
    def physical(self) -> tuple[str, ...]:
        """Those of `kinds` that need mass, wheels and motors; the others can happen to any plant."""
        return tuple(name for name in self.kinds if name not in _ANY_PLANT)

    @property
    def spans(self) -> tuple[Span, ...]:
        """Begin and last change of every disturbance whose times are known beforehand: all but the patches."""
        timed: Iterable[Window | BatterySag] = (
            *self.weak_motors,
            *self.slipping_wheels,
            *([self.battery] if self.battery else ()),
            *self.drop_outs,
            *self.false_commands,
            *self.pushes,
            *self.blockades,
        )
        from_the_start = any((self.start_offset, self.payload, self.slope))
        return (*([(0.0, 0.0)] if from_the_start else ()), *(item.span for item in timed))


@dataclass(frozen=True)
class ScenarioFile:
    """A scenario as its file describes it, ranges and choices included; it has been checked.

    Attributes
    ----------
    path
        The file.
    data
        What stands in it.
    """

    path: Path
    data: Any

    def draw(self, seed: int) -> Scenario:
        """The scenario of the run with `seed` (not negative): always the same for the same seed."""
        stream = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_SPAWN_KEY,)))
        return check(Scenario, drawn(self.data, stream), str(self.path))


def load_scenario(name: str | Path) -> ScenarioFile:
    """Read a scenario by shipped name or path.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such scenario, its file has a mistake, or a value out of range could be drawn from it.
    """
    path = named_file("scenario", SCENARIOS, name)
    data = read_yaml(path)
    check_drawn(data, str(path))
    for values in extremes(data):
        check(Scenario, values, str(path))
    return ScenarioFile(path, data)
