"""Schemas of the types of disturbance.

Forward, left and yaw are in the body frame, with x forward and y left; the world frame is that of the reference. Times
count from the start of the run; a disturbance without `duration` lasts until its end.
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
"""Start and end of a disturbance [s]; the end is infinite if it lasts until the end of the run."""


class Window(StrictModel):
    """A time window."""

    start: NotNegative = Field(description="start time [s]")
    duration: Positive | None = Field(None, description="duration [s]; by default until the end of the run")

    @property
    def end(self) -> float:
        """End time [s]; infinite for the end of the run."""
        return math.inf if self.duration is None else self.start + self.duration

    @property
    def span(self) -> Span:
        """Start and end time [s]."""
        return (self.start, self.end)

    def holds(self, time: float) -> bool:
        """Return True if `time` [s] is within the window, end excluded."""
        return self.start <= time < self.end

    def share(self, start: float, end: float) -> float:
        """Compute the share of [start, end] [s] within the window, 0 to 1."""
        return max(0.0, min(end, self.end) - max(start, self.start)) / (end - start)


class StartOffset(StrictModel):
    """Offset of the robot's start pose from that of the reference."""

    along: float = Field(0.0, description="offset ahead [m]")
    across: float = Field(0.0, description="offset to the left [m]")
    heading: float = Field(0.0, description="heading offset to the left [rad]")


class Patch(StrictModel):
    """Stretch of the path with different friction."""

    start: NotNegative = Field(description="distance travelled by the robot's centre at the start of the patch [m]")
    length: Positive | None = Field(None, description="length along the path [m]; by default until the end of the run")
    friction: Positive | None = Field(None, description="sliding friction coefficient [-]; alternative to `factor`")
    factor: Positive | None = Field(None, description="friction over that of the surrounding surface [-]")
    side: Literal["both", "left", "right"] = Field("both", description="side of the wheels on the patch")

    @model_validator(mode="after")
    def _one_of_both(self) -> Patch:
        if (self.friction is None) == (self.factor is None):
            raise ValueError("give either friction or factor")
        return self

    def coefficient(self, floor: float) -> float:
        """Compute the sliding friction coefficient; `floor` is that of the surrounding surface."""
        return self.friction if self.friction is not None else float(self.factor or 1.0) * floor


class Payload(StrictModel):
    """A ball fixed to the body during the whole run."""

    mass: Positive = Field(description="mass [kg]")
    x: float = Field(0.0, description="position ahead of the robot's centre [m]")
    y: float = Field(0.0, description="position to the left of the robot's centre [m]")
    z: float = Field(0.0, description="height above the axles [m]")
    radius: Positive = Field(description="radius of the ball, for its inertia [m]")


class Slope(StrictModel):
    """A uniformly tilted surface."""

    angle: float = Field(ge=0, le=0.6, description="angle to the horizontal [rad]")
    downhill: float = Field(0.0, description="direction of descent in the world frame, from the x axis [rad]")


class WeakMotor(Window):
    """A motor with reduced torque."""

    wheel: Wheel = Field(description="wheel of the motor")
    factor: Fraction = Field(description="torque over that of the intact motor [-]")


class SlippingWheel(Window):
    """A wheel with reduced friction."""

    wheel: Wheel = Field(description="slipping wheel")
    friction: Positive = Field(description="sliding friction coefficient of the wheel [-]")


class BatterySag(StrictModel):
    """A falling supply voltage; no-load speed and stall torque fall in proportion."""

    start: NotNegative = Field(description="start of the fall [s]")
    duration: Positive = Field(description="duration of the fall [s]")
    before: float = Field(1.0, gt=0, le=1, description="voltage before the fall, over nominal [-]")
    after: float = Field(gt=0, le=1, description="voltage after the fall, over nominal [-]")
    load_drop: float = Field(0.0, ge=0, lt=1, description="voltage drop with all motors at stall, over nominal [-]")

    @property
    def span(self) -> Span:
        """Start of the fall and end [s]; the end is infinite, as the voltage does not recover."""
        return (self.start, math.inf)

    def voltage(self, time: float) -> float:
        """Compute the open-circuit voltage at `time` [s] over nominal."""
        progress = min(1.0, max(0.0, (time - self.start) / self.duration))
        return self.before + progress * (self.after - self.before)


class DropOut(Window):
    """A sensor without readings."""

    sensor: Sensor = Field(description="failed sensor")
    duration: Positive = Field(description="duration [s]")


class StuckSensor(Window):
    """A sensor that repeats its last value with advancing stamps."""

    sensor: Sensor = Field(description="stuck sensor")


class DeadEncoders(Window):
    """Encoders of one or more wheels that read zero; the motor drivers still measure the wheel speeds."""

    wheels: Annotated[tuple[Wheel, ...], Field(min_length=1)] = Field(description="wheels that read zero")


class GyroBias(Window):
    """A gyro with a constant bias."""

    bias: float = Field(description="bias of the yaw rate [rad/s]")


class PoseError(Window):
    """Poses with an offset and a drift in the world frame; stamps and noise are unchanged."""

    x: float = Field(0.0, description="offset in x [m]")
    y: float = Field(0.0, description="offset in y [m]")
    heading: float = Field(0.0, description="heading offset to the left [rad]")
    x_rate: float = Field(0.0, description="drift in x [m/s]")
    y_rate: float = Field(0.0, description="drift in y [m/s]")
    heading_rate: float = Field(0.0, description="heading drift to the left [rad/s]")


class FalseCommand(Window):
    """A command that replaces the controller's command without notification."""

    v: float = Field(description="forward speed [m/s]")
    omega: float = Field(description="yaw rate [rad/s]")
    duration: Positive = Field(description="duration [s]")


class Push(Window):
    """A horizontal force that turns with the body; it acts at the horizontal position of the centre of mass."""

    force: NotNegative = Field(0.0, description="horizontal force [N]")
    height: NotNegative = Field(description="height of the force above the surface [m]")
    direction: float = Field(0.0, description="direction of the force, from forward to the left [rad]")
    yaw_torque: float = Field(0.0, description="torque to the left about the vertical axis [N m]")
    duration: Positive = Field(description="duration [s]")


class Blockade(Window):
    """A compliant obstacle that holds the body in place.

    The upper bounds of stiffness and damping are those that the physics step of 2 ms resolves.
    """

    stiffness: float = Field(gt=0, le=2e4, description="horizontal stiffness [N/m]")
    height: NotNegative = Field(description="height of the contact with the body above the surface [m]")
    damping: float = Field(gt=0, le=1e3, description="horizontal damping [N s/m]")
    yaw_stiffness: float = Field(gt=0, le=1e3, description="yaw stiffness [N m/rad]")
    yaw_damping: float = Field(gt=0, le=20, description="yaw damping [N m s/rad]")
    duration: Positive = Field(description="duration [s]")
