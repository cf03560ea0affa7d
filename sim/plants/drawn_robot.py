"""A robot of the market, drawn from a seed: build, floor, disturbances, pose source, and its user's data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from diffdrive_mpc.models.checked_yaml import StrictModel, check, load_checked, merge_mappings
from diffdrive_mpc.models.robot import NotNegative, Positive
from diffdrive_mpc.sim.disturbances.scenario import Scenario
from diffdrive_mpc.sim.plants.chassis import WHEELS
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot, digital_twin

# Ranges of robots on the market, from which the population is drawn, and requirements of paths.


_FILE = Path(__file__).with_name("market.yaml")


def _sorted(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"the range [{ends[0]:g}, {ends[1]:g}] ends before it begins")
    return ends


Range = Annotated[tuple[float, float], AfterValidator(_sorted)]
Span = tuple[Positive, Positive]
"""From the best to the worst, by its logarithm."""
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class WheelShares(StrictModel):
    """Distribution of wheel types."""

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


class DrawnWeakMotor(StrictModel):
    """One motor that is weak from the start."""

    often: Share = Field(description="share of the robots that have one [-]")
    factor: Range = Field(description="torque over nominal [-]")


class DeadMotor(StrictModel):
    """Motor that fails during the drive."""

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
    """Distribution of the error of the stated track."""

    wrong: Share = Field(description="share that states a wrong one [-]")
    factor: Range = Field(description="stated over true [-]")


class StatedRobot(StrictModel):
    """Robot as its user states it."""

    track: StatedTrack = Field(description="the only thing that is stated wrong")
    yaw_acceleration: Share = Field(
        description="omega_slew that is stated, over what grip turns the body by on the usual floor [-]"
    )


class Needs(StrictModel):
    """Requirements of a path; robots that cannot meet them are not drawn for it."""

    speed: Positive = Field(description="[m/s]")
    turning: Positive = Field(description="yaw rate at that speed [rad/s]")
    acceleration: Positive = Field(description="of the reference [m/s^2]")
    yaw_acceleration: Positive = Field(description="of the reference [rad/s^2]")
    sliding: Share = Field(description="speed down a slope in a curve, over the speed [-]")
    skid_time: Positive = Field(description="time constant of the speed while wheels skid in a turn [s]")
    turning_point: Positive = Field(description="how far from its middle it may turn on the spot [m]")


class Market(StrictModel):
    """The ranges; `market.yaml` states the reference and the source of each."""

    mass: Range = Field(description="by its logarithm [kg]")
    track: Range = Field(description="over that of the scaled robot [-]")
    wheel_base: Range = Field(description="over the track [-]")
    wheel_radius: Range = Field(description="over the track [-]")
    torque: Range = Field(description="stall torque over that of the scaled robot [-]")
    top_speed: Range = Field(description="over the speed of the faster wheels on the paths [-]")
    driven: WheelShares = Field(description="how often")
    centre_of_mass: Range = Field(description="of wheel base and track, from the middle [-]")
    rolling_radii: Range = Field(description="difference of left and right over the radius [-]")
    motor_spread: Range = Field(description="torque of each motor over nominal [-]")
    weak_motor: DrawnWeakMotor = Field(description="one weak motor")
    dead_motor: DeadMotor = Field(description="one motor that dies")
    dead_time: Range = Field(description="of the link [s]")
    lag: Range = Field(description="of each channel of the firmware [s]")
    skid_correction: Range = Field(description="share of the track's widening by skid that firmware makes up for [-]")
    friction: Range = Field(description="by its logarithm [-]")
    patches: Patches = Field(description="stretches of another floor")
    slope: Slopes = Field(description="slopes")
    pose: PoseSources = Field(description="pose sources")
    stated: StatedRobot = Field(description="what the user states")
    needs: Needs = Field(description="of the paths")
    turning_point: Positive = Field(description="how far ahead four driven wheels turn, over the centre of mass [-]")
    margin: Positive = Field(description="over grip, torque and commands that the paths need [-]")


@cache
def load_market() -> Market:
    """Read the shipped market; raises ConfigError when it has a mistake."""
    return load_checked(Market, _FILE)


GRAVITY = 9.81
"""Gravity that the market is drawn with [m/s^2]."""


@dataclass(frozen=True)
class DrawnRobot:
    """One robot of the population.

    Attributes
    ----------
    seed
        Seed of the draw.
    build
        Body, drives, firmware, floor and sensors.
    scenario
        Slope, patches and motors of this robot.
    stated
        Configuration values by dotted key that its user knows; the tracks may be wrong.
    truth
        The same with the tracks right.
    """

    seed: int
    build: SimulatedRobot
    scenario: Scenario
    stated: Mapping[str, float]
    truth: Mapping[str, float]


def on_driven(build: SimulatedRobot) -> float:
    """Compute the share of the weight on driven wheels."""
    chassis = build.twin.chassis
    return 1.0 + chassis.centre_of_mass[0] / chassis.wheel_base if chassis.castors else 1.0


def yaw_acceleration(build: SimulatedRobot, grip: float) -> float:
    """Compute the yaw acceleration that driven wheels give a box of its size on a floor of this friction [rad/s^2]."""
    chassis, track = build.twin.chassis, build.robot.track
    behind = chassis.centre_of_mass[0] if chassis.castors else 0.0
    inertia = (chassis.wheel_base**2 + track**2) / 12.0 + behind**2
    return grip * GRAVITY * on_driven(build) * track / 2.0 / inertia


def skid_track(track: float, wheel_base: float) -> float:
    """Compute the effective track of a skidding robot [m] for Coulomb friction about the wheels' centre."""
    return track * (1.0 + (wheel_base / track) ** 2)


def rim_speed(track: float, wheel_base: float) -> float:
    """Compute the speed of the faster wheels on the benchmark paths [m/s]."""
    needs = load_market().needs
    return needs.speed + 0.5 * needs.turning * skid_track(track, wheel_base)


def draw_robot(seed: int) -> DrawnRobot:
    """Draw the robot of `seed` (not negative); the same seed gives the same one."""
    market, stream = load_market(), np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(4711,)))
    build = _draw_build(market, stream, f"robot {seed} of the market")
    befalls: dict[str, Any] = {"description": "what befalls it", "patches": [], "slope": None}
    castors = build["twin"]["chassis"]["castors"]
    build["twin"]["motor"]["spread"], befalls["weak_motors"] = _draw_motors(market, stream, castors=castors)
    build["friction"] = _logarithmic(stream, market.friction)
    patch = {name: _uniform(stream, getattr(market.patches, name)) for name in ("start", "length", "factor")}
    if stream.random() < market.patches.often:
        befalls["patches"] = [patch]
    sloped = stream.random() < market.slope.often
    slope = {"angle": _uniform(stream, market.slope.angle), "downhill": _uniform(stream, (-math.pi, math.pi))}
    if sloped:
        befalls["slope"] = slope
    twin = digital_twin()
    usual: Any = twin["robot"]
    build["sensors"] = {"pose": _draw_pose_source(market.pose, stream, usual["sample_time"])}
    factor = _uniform(stream, market.stated.track.factor)
    factor = factor if stream.random() < market.stated.track.wrong else 1.0
    build["twin"]["motor"]["stall_torque"] *= _uniform(stream, market.torque)
    where = f"market.yaml, seed {seed}"
    robot = check(SimulatedRobot, merge_mappings(twin, build), where)
    truth = _true_settings(robot)
    stated = truth | {name: factor * truth[name] for name in ("wheels.track", "wheels.encoder_track")}
    return DrawnRobot(seed, robot, check(Scenario, befalls, where), stated, truth)


def _draw_build(market: Market, stream: np.random.Generator, description: str) -> dict[str, Any]:
    """Draw body, drives, link and firmware as changes to the digital twin, with torques of its scaled motors."""
    twin = digital_twin()
    usual_robot: Any = twin["robot"]
    usual: Any = twin["twin"]
    mass = _logarithmic(stream, market.mass)
    track = usual_robot["track"] * (mass / usual_robot["mass"]) ** (1 / 3) * _uniform(stream, market.track)
    wheel_base = track * _uniform(stream, market.wheel_base)
    radius = track * _uniform(stream, market.wheel_radius)
    castors = bool(stream.random() < market.driven.castors / (market.driven.castors + market.driven.wheels_4))
    skidding_base = 0.0 if castors else wheel_base
    no_load = _uniform(stream, market.top_speed) * rim_speed(track, skidding_base) / radius
    ahead = _uniform(stream, market.centre_of_mass) * wheel_base - (0.3 * wheel_base if castors else 0.0)
    left = _uniform(stream, market.centre_of_mass) * track
    difference = _uniform(stream, market.rolling_radii) / 2
    correction = _uniform(stream, market.skid_correction)
    larger, heavier = radius / usual_robot["wheel_radius"], mass / usual_robot["mass"]
    quicker = usual["motor"]["no_load_speed"] / no_load
    return {
        "description": description,
        "robot": {"mass": mass, "track": track, "wheel_radius": radius},
        "twin": {
            "chassis": {
                "wheel_base": wheel_base,
                "body_size": [wheel_base + radius, 0.8 * track, 0.3 * track],
                "body_height": 0.1 * track,
                "wheel_mass": usual["chassis"]["wheel_mass"] * heavier,
                "centre_of_mass": [ahead, left],
                "rolling_radii": [1.0 - difference, 1.0 + difference],
                "castors": castors,
            },
            "motor": {
                "stall_torque": usual["motor"]["stall_torque"] * heavier * larger,
                "no_load_speed": no_load,
                "rotor_inertia": usual["motor"]["rotor_inertia"] * heavier * larger**2,
            },
            "driver": {gain: usual["driver"][gain] * quicker for gain in ("proportional_gain", "integral_gain")},
            "link": {"dead_time": _uniform(stream, market.dead_time)},
        },
        "firmware": {
            "lag_v": _uniform(stream, market.lag),
            "lag_omega": _uniform(stream, market.lag),
            "track": track + correction * (skid_track(track, skidding_base) - track),
        },
    }


def _true_settings(build: SimulatedRobot) -> dict[str, float]:
    """Compute the true configuration values by dotted key, except for patches and slopes."""
    pose, link, usual = build.sensors.pose, build.twin.link, digital_twin()
    usual_twin: Any = usual["twin"]
    usual_robot: Any = usual["robot"]
    later = max(0.0, link.dead_time - usual_twin["link"]["dead_time"])
    every = pose.period / (1.0 - pose.loss) if pose.period else 0.0
    turned = load_market().stated.yaw_acceleration * yaw_acceleration(build, float(build.friction or 0.0))
    return {
        "wheels.track": build.firmware.track,
        "wheels.encoder_track": build.robot.track,
        "limits.wheel_speed": 0.97 * build.twin.motor.no_load_speed * build.robot.wheel_radius,
        "limits.omega_slew": min(usual_robot["command_slew"]["omega"], turned),
        "extra_dead_time.v": later,
        "extra_dead_time.omega": later,
        "estimator.history": max(0.4, 1.3 * pose.latency + 0.1),
        "failure.max_pose_age": max(0.5, pose.latency + 5 * every),
    }


def _uniform(stream: np.random.Generator, ends: tuple[float, float]) -> float:
    return float(stream.uniform(*ends))


def _logarithmic(stream: np.random.Generator, ends: tuple[float, float]) -> float:
    return math.exp(_uniform(stream, (math.log(ends[0]), math.log(ends[1]))))


def _draw_motors(
    market: Market, stream: np.random.Generator, *, castors: bool
) -> tuple[list[float], list[dict[str, Any]]]:
    """Draw the torque of each motor over nominal, and failing motors; castors have no reserve."""
    spread = [_uniform(stream, market.motor_spread) for _ in WHEELS]
    weak, dead = market.weak_motor, market.dead_motor
    weak_wheel, weak_factor = int(stream.integers(2 if castors else 4)), _uniform(stream, weak.factor)
    if stream.random() < weak.often:
        spread[weak_wheel] *= weak_factor
    dead_wheel, dead_from = int(stream.integers(4)), _uniform(stream, dead.start)
    dies = stream.random() < dead.often and not castors
    return spread, [{"wheel": WHEELS[dead_wheel], "factor": 0.0, "start": dead_from}] if dies else []


def _draw_pose_source(ranges: PoseSources, stream: np.random.Generator, sample_time: float) -> dict[str, Any]:
    """Draw the pose sensor: a common quality, and individual deviations from it."""
    quality = stream.random()

    def draw(ends: tuple[float, float]) -> float:
        share = np.clip(quality + ranges.jitter * stream.uniform(-1.0, 1.0), 0.0, 1.0)
        best, worst = np.log(ends)
        return float(np.exp(best + share * (worst - best)))

    values: dict[str, Any] = {name: draw(getattr(ranges, name)) for name in ("latency", "position_sd", "heading_sd")}
    period, loss = 1.0 / draw(ranges.rate), _uniform(stream, ranges.loss)
    lossy = stream.random() < 0.5
    return {**values, "period": period if period > sample_time else None, "loss": loss if lossy else 0.0}
