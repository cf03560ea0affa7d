"""Types of disturbance, with one schema for each.

Frames: forward, left and yaw are the body's, x forward and y left; world is that of the reference. Times count from the
start of the run, and a disturbance without `duration` lasts to its end.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.robot import NotNegative, Positive

Wheel = Literal["front_left", "front_right", "rear_left", "rear_right"]
Sensor = Literal["pose", "wheels", "gyro"]
Fraction = Annotated[float, Field(ge=0, le=1)]
Span = tuple[float, float]
"""When a disturbance begins and when it is over [s]; infinity for one that lasts to the end of the run."""


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
        """Begin and end [s]."""
        return (self.start, self.end)

    def holds(self, time: float) -> bool:
        """Return True if `time` [s] lies within the disturbance, its end excluded."""
        return self.start <= time < self.end

    def share(self, start: float, end: float) -> float:
        """Compute the share of [start, end] [s] within the disturbance, 0 to 1."""
        return max(0.0, min(end, self.end) - max(start, self.start)) / (end - start)


class StartOffset(StrictModel):
    """The robot does not start on the reference."""

    along: float = Field(0.0, description="ahead of the reference's start pose [m]")
    across: float = Field(0.0, description="to its left [m]")
    heading: float = Field(0.0, description="turned to the left [rad]")


class Patch(StrictModel):
    """Stretch of the path with other friction."""

    start: NotNegative = Field(description="distance travelled by the robot's middle where it begins [m]")
    length: Positive | None = Field(None, description="along the way [m]; without: to the end of the run")
    friction: Positive | None = Field(None, description="sliding friction coefficient there; or else:")
    factor: Positive | None = Field(None, description="that coefficient over the one of the floor beside it")
    side: Literal["both", "left", "right"] = Field("both", description="wheels that it is under")

    @model_validator(mode="after")
    def _one_of_both(self) -> Patch:
        if (self.friction is None) == (self.factor is None):
            raise ValueError("give either friction or factor")
        return self

    def coefficient(self, floor: float) -> float:
        """Compute the sliding friction coefficient for a surrounding floor with the coefficient `floor`."""
        return self.friction if self.friction is not None else float(self.factor or 1.0) * floor


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
        """Begin of the fall [s]; the voltage does not come back."""
        return (self.start, math.inf)

    def voltage(self, time: float) -> float:
        """Compute the open-circuit voltage at `time` [s] over nominal."""
        progress = min(1.0, max(0.0, (time - self.start) / self.duration))
        return self.before + progress * (self.after - self.before)


class DropOut(Window):
    """A sensor that delivers nothing."""

    sensor: Sensor = Field(description="which sensor")
    duration: Positive = Field(description="how long [s]")


class StuckSensor(Window):
    """Sensor that repeats its last value with advancing stamps."""

    sensor: Sensor = Field(description="which sensor")


class DeadEncoders(Window):
    """Encoders of one or more wheels that count nothing; the motor drivers still know their speeds."""

    wheels: Annotated[tuple[Wheel, ...], Field(min_length=1)] = Field(description="wheels that read zero")


class GyroBias(Window):
    """A gyro that is off by a constant."""

    bias: float = Field(description="added to the yaw rate [rad/s]")


class PoseError(Window):
    """Poses that are off at once and drift away, in the world's frame; with their usual stamps and noise."""

    x: float = Field(0.0, description="off from the start on [m]")
    y: float = Field(0.0, description="off from the start on [m]")
    heading: float = Field(0.0, description="off from the start on, to the left [rad]")
    x_rate: float = Field(0.0, description="drift [m/s]")
    y_rate: float = Field(0.0, description="drift [m/s]")
    heading_rate: float = Field(0.0, description="drift to the left [rad/s]")


class FalseCommand(Window):
    """The motors get another command than the controller sent, without any notice."""

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
    """Yielding obstacle that holds the body at its place, whatever the wheels do.

    The upper bounds are those of a spring and a damper that the physics step of 2 ms still resolves.
    """

    stiffness: float = Field(gt=0, le=2e4, description="against motion along the floor [N/m]")
    height: NotNegative = Field(description="where it touches the body, above the floor [m]")
    damping: float = Field(gt=0, le=1e3, description="against motion along the floor [N s/m]")
    yaw_stiffness: float = Field(gt=0, le=1e3, description="against turning [N m/rad]")
    yaw_damping: float = Field(gt=0, le=20, description="against turning [N m s/rad]")
    duration: Positive = Field(description="how long [s]")
