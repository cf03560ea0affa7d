"""What robots on the market are like: the ranges that a robot of the population is drawn from, and what paths need."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import NotNegative, Positive

_FILE = Path(__file__).with_name("market.yaml")


def _sorted(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"the range [{ends[0]:g}, {ends[1]:g}] ends before it begins")
    return ends


Range = Annotated[tuple[float, float], AfterValidator(_sorted)]
Span = tuple[Positive, Positive]
"""From the best to the worst, by its logarithm."""
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class Driven(StrictModel):
    """How often robots have which wheels."""

    wheels_4: NotNegative = Field(description="four driven wheels [-]")
    castors: NotNegative = Field(description="two driven wheels and castors [-]")


class Patches(StrictModel):
    """Stretches of another floor."""

    often: Share = Field(description="share of the robots that meet one [-]")
    factor: Range = Field(description="friction over that of the floor beside it [-]")
    start: Range = Field(description="along the way [m]")
    length: Range = Field(description="along the way [m]")


class Slopes(StrictModel):
    """Slopes in any direction."""

    often: Share = Field(description="share of the floors that slope [-]")
    angle: Range = Field(description="[rad]")


class WeakMotor(StrictModel):
    """One motor that is weak from the start."""

    often: Share = Field(description="share of the robots that have one [-]")
    factor: Range = Field(description="torque over nominal [-]")


class DeadMotor(StrictModel):
    """One motor that dies on the way."""

    often: Share = Field(description="share of the robots with four driven wheels [-]")
    start: Range = Field(description="when [s]")


class PoseSources(StrictModel):
    """Pose sources, each from the best to the worst: one quality draws all."""

    rate: Span = Field(description="[Hz]")
    latency: Span = Field(description="[s]")
    position_sd: Span = Field(description="[m]")
    heading_sd: Span = Field(description="[rad]")
    jitter: Share = Field(description="how far each lies beside the common quality [-]")
    loss: Range = Field(description="share of poses lost, by every second source [-]")


class StatedTrack(StrictModel):
    """How right users state their track."""

    wrong: Share = Field(description="share that states a wrong one [-]")
    factor: Range = Field(description="stated over true [-]")


class Stated(StrictModel):
    """What a user states of the robot."""

    track: StatedTrack = Field(description="the only thing that is stated wrong")
    yaw_acceleration: Share = Field(
        description="omega_slew that is stated, over what grip turns the body by on the usual floor [-]"
    )


class Needs(StrictModel):
    """What a path asks of a robot: one that cannot do it is not drawn for it."""

    speed: Positive = Field(description="[m/s]")
    turning: Positive = Field(description="yaw rate at that speed [rad/s]")
    acceleration: Positive = Field(description="of the reference [m/s^2]")
    yaw_acceleration: Positive = Field(description="of the reference [rad/s^2]")
    sliding: Share = Field(description="speed down a slope in a curve, over the speed [-]")
    skid_time: Positive = Field(description="time constant of the speed while wheels skid in a turn [s]")
    turning_point: Positive = Field(description="how far from its middle it may turn on the spot [m]")


class Market(StrictModel):
    """The ranges; `market.yaml` says what each is over, and where it comes from."""

    mass: Range = Field(description="by its logarithm [kg]")
    track: Range = Field(description="over that of the scaled robot [-]")
    wheel_base: Range = Field(description="over the track [-]")
    wheel_radius: Range = Field(description="over the track [-]")
    torque: Range = Field(description="stall torque over that of the scaled robot [-]")
    top_speed: Range = Field(description="over the speed of the faster wheels on the paths [-]")
    driven: Driven = Field(description="how often")
    centre_of_mass: Range = Field(description="of wheel base and track, from the middle [-]")
    rolling_radii: Range = Field(description="difference of left and right over the radius [-]")
    motor_spread: Range = Field(description="torque of each motor over nominal [-]")
    weak_motor: WeakMotor = Field(description="one weak motor")
    dead_motor: DeadMotor = Field(description="one motor that dies")
    dead_time: Range = Field(description="of the link [s]")
    lag: Range = Field(description="of each channel of the firmware [s]")
    skid_correction: Range = Field(description="share of the track's widening by skid that firmware makes up for [-]")
    friction: Range = Field(description="by its logarithm [-]")
    patches: Patches = Field(description="stretches of another floor")
    slope: Slopes = Field(description="slopes")
    pose: PoseSources = Field(description="pose sources")
    stated: Stated = Field(description="what the user states")
    needs: Needs = Field(description="of the paths")
    turning_point: Positive = Field(description="how far ahead four driven wheels turn, over the centre of mass [-]")
    margin: Positive = Field(description="over grip, torque and commands that the paths need [-]")


@cache
def load_market() -> Market:
    """Read the shipped market; raises ConfigError when it has a mistake."""
    return load_checked(Market, _FILE)
