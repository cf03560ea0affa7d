"""Schemas of the types of disturbances.

Forward, left and yaw are in the body frame, with x forward and y left; the world frame is that of the reference. Times
are relative to the start of the run; a disturbance without `duration` lasts until the end of the run.
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
    """Time window of a disturbance."""

    start: NotNegative = Field(description="start time [s]")
    duration: Positive | None = Field(None, description="duration [s]; default: until the end of the run")

    @property
    def end(self) -> float:
        """End time [s]; infinite if the window lasts until the end of the run."""
        return math.inf if self.duration is None else self.start + self.duration

    @property
    def span(self) -> Span:
        """Start and end time [s]."""
        return (self.start, self.end)

    def contains(self, time: float) -> bool:
        """Return True if `time` [s] is within the window, which excludes its end."""
        return self.start <= time < self.end

    def share(self, start: float, end: float) -> float:
        """Compute the share of the interval [start, end] [s] within the window, from 0 to 1."""
        return max(0.0, min(end, self.end) - max(start, self.start)) / (end - start)


class StartOffset(StrictModel):
    """Offset of the robot's start pose from the start of the reference, in the direction of the reference."""

    along: float = Field(0.0, description="offset ahead [m]")
    across: float = Field(0.0, description="offset to the left [m]")
    heading: float = Field(0.0, description="heading offset to the left [rad]")


class Patch(StrictModel):
    """Section of the path with different friction."""

    start: NotNegative = Field(description="distance travelled by the robot's centre at the start of the patch [m]")
    length: Positive | None = Field(None, description="length along the path [m]; default: until the end of the run")
    friction: Positive | None = Field(None, description="sliding friction coefficient [-]; alternative to `factor`")
    factor: Positive | None = Field(None, description="ratio of friction to that of the surrounding surface [-]")
    side: Literal["both", "left", "right"] = Field("both", description="side whose wheels are on the patch")

    @model_validator(mode="after")
    def _check_exclusive(self) -> Patch:
        if (self.friction is None) == (self.factor is None):
            raise ValueError("give either friction or factor")
        return self

    def coefficient(self, surface: float) -> float:
        """Compute the sliding friction coefficient on a surface with the coefficient `surface`."""
        return self.friction if self.friction is not None else float(self.factor or 1.0) * surface


class Payload(StrictModel):
    """Ball that is fixed to the body during the whole run."""

    mass: Positive = Field(description="mass [kg]")
    x: float = Field(0.0, description="position ahead of the robot's centre [m]")
    y: float = Field(0.0, description="position to the left of the robot's centre [m]")
    z: float = Field(0.0, description="height above the axles [m]")
    radius: Positive = Field(description="radius of the ball, which determines its inertia [m]")


class Slope(StrictModel):
    """Uniformly tilted surface."""

    angle: float = Field(ge=0, le=0.6, description="angle to the horizontal [rad]")
    downhill: float = Field(0.0, description="direction of descent in the world frame, from the x axis [rad]")


class WeakMotor(Window):
    """Motor with reduced torque."""

    wheel: Wheel = Field(description="wheel of the motor")
    factor: Fraction = Field(description="ratio of torque to that of the intact motor [-]")


class SlippingWheel(Window):
    """Wheel with reduced friction."""

    wheel: Wheel = Field(description="slipping wheel")
    friction: Positive = Field(description="sliding friction coefficient of the wheel [-]")


class BatterySag(StrictModel):
    """Falling supply voltage; no-load speed and stall torque fall in proportion."""

    start: NotNegative = Field(description="start of the fall [s]")
    duration: Positive = Field(description="duration of the fall [s]")
    before: float = Field(
        1.0, gt=0, le=1, description="ratio of the voltage before the fall to the nominal voltage [-]"
    )
    after: float = Field(gt=0, le=1, description="ratio of the voltage after the fall to the nominal voltage [-]")
    load_drop: float = Field(0.0, ge=0, lt=1, description="relative voltage drop with all motors at stall [-]")

    @property
    def span(self) -> Span:
        """Start of the fall, and infinity as the end, since the voltage does not recover [s]."""
        return (self.start, math.inf)

    def voltage(self, time: float) -> float:
        """Compute the ratio of the open-circuit voltage at `time` [s] to the nominal voltage."""
        progress = min(1.0, max(0.0, (time - self.start) / self.duration))
        return self.before + progress * (self.after - self.before)


class DropOut(Window):
    """Sensor without readings."""

    sensor: Sensor = Field(description="failed sensor")
    duration: Positive = Field(description="duration [s]")


class StuckSensor(Window):
    """Sensor that repeats its last value with advancing stamps."""

    sensor: Sensor = Field(description="stuck sensor")


class DeadEncoders(Window):
    """Encoders of one or more wheels whose readings are zero; the motor drivers are not affected."""

    wheels: Annotated[tuple[Wheel, ...], Field(min_length=1)] = Field(description="wheels whose encoder reads zero")


class GyroBias(Window):
    """Gyro with a constant bias."""

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
    """Command that replaces the controller's command without notification."""

    v: float = Field(description="forward speed [m/s]")
    omega: float = Field(description="yaw rate [rad/s]")
    duration: Positive = Field(description="duration [s]")


class Push(Window):
    """Horizontal force with a constant direction relative to the body, at the horizontal centre of mass."""

    force: NotNegative = Field(0.0, description="horizontal force [N]")
    height: NotNegative = Field(description="height of the force above the surface [m]")
    direction: float = Field(0.0, description="direction of the force, from forward to the left [rad]")
    yaw_torque: float = Field(0.0, description="torque to the left about the vertical axis [N m]")
    duration: Positive = Field(description="duration [s]")


class Blockade(Window):
    """Compliant obstacle that holds the body in place.

    At the physics step of 2 ms, stiffness and damping above the upper bounds would be numerically unstable.
    """

    stiffness: float = Field(gt=0, le=2e4, description="horizontal stiffness [N/m]")
    height: NotNegative = Field(description="height of the contact with the body above the surface [m]")
    damping: float = Field(gt=0, le=1e3, description="horizontal damping [N s/m]")
    yaw_stiffness: float = Field(gt=0, le=1e3, description="yaw stiffness [N m/rad]")
    yaw_damping: float = Field(gt=0, le=20, description="yaw damping [N m s/rad]")
    duration: Positive = Field(description="duration [s]")
