"""Random robots of the market by seed: build, surface, disturbances, pose source, and data stated by the user."""

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

_FILE = Path(__file__).with_name("market.yaml")


def _check_range(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"range [{ends[0]:g}, {ends[1]:g}]: give the lower end first")
    return ends


Range = Annotated[tuple[float, float], AfterValidator(_check_range)]
Span = tuple[Positive, Positive]
"""Range from the best to the worst value, with logarithmic interpolation."""
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class WheelShares(StrictModel):
    """Relative frequencies of wheel types."""

    wheels_4: NotNegative = Field(description="relative frequency of four driven wheels [-]")
    castors: NotNegative = Field(description="relative frequency of two driven wheels and castors [-]")


class Patches(StrictModel):
    """Patches with different friction."""

    often: Share = Field(description="probability of a patch [-]")
    factor: Range = Field(description="ratio of friction to that of the surrounding surface [-]")
    start: Range = Field(description="distance of the start along the path [m]")
    length: Range = Field(description="length along the path [m]")


class Slopes(StrictModel):
    """Slopes in any direction."""

    often: Share = Field(description="probability of a slope [-]")
    angle: Range = Field(description="angle of the slope [rad]")


class DrawnWeakMotor(StrictModel):
    """Motor that is weak from the start."""

    often: Share = Field(description="probability of a weak motor [-]")
    factor: Range = Field(description="ratio of torque to nominal torque [-]")


class DeadMotor(StrictModel):
    """Motor that fails during the drive."""

    often: Share = Field(description="probability for robots with four driven wheels [-]")
    start: Range = Field(description="time of the failure [s]")


class PoseSources(StrictModel):
    """Ranges of pose sources from best to worst value; a random quality of the source interpolates all ranges."""

    rate: Span = Field(description="rate of poses [Hz]")
    latency: Span = Field(description="latency of poses [s]")
    position_sd: Span = Field(description="standard deviation of x and y [m]")
    heading_sd: Span = Field(description="standard deviation of theta [rad]")
    jitter: Share = Field(description="maximum deviation of each value from the common quality [-]")
    loss: Range = Field(description="share of lost poses, which half of the sources have [-]")


class StatedTrack(StrictModel):
    """Distribution of the error of the stated track."""

    wrong: Share = Field(description="probability of a wrong track [-]")
    factor: Range = Field(description="ratio of stated to true track [-]")


class StatedRobot(StrictModel):
    """Data of the robot that its user states."""

    track: StatedTrack = Field(description="stated track, which is the only value that may be wrong")
    yaw_acceleration: Share = Field(
        description="ratio of stated omega_slew to the yaw acceleration that the grip outside patches permits [-]"
    )


class Needs(StrictModel):
    """Requirements of the paths; robots that do not meet them are not drawn."""

    speed: Positive = Field(description="speed [m/s]")
    turning: Positive = Field(description="yaw rate at `speed` [rad/s]")
    acceleration: Positive = Field(description="acceleration of the reference [m/s^2]")
    yaw_acceleration: Positive = Field(description="yaw acceleration of the reference [rad/s^2]")
    sliding: Share = Field(description="ratio of sliding speed down a slope in a curve to speed [-]")
    skid_time: Positive = Field(description="time constant of the speed while wheels skid in a turn [s]")
    turning_point: Positive = Field(
        description="maximum distance of the centre of rotation from the centre of the robot [m]"
    )


class Market(StrictModel):
    """Ranges of the market; for reference values and sources see `market.yaml`."""

    mass: Range = Field(description="mass, log-uniform [kg]")
    track: Range = Field(description="ratio of track to that of the scaled robot [-]")
    wheel_base: Range = Field(description="ratio of wheel base to track [-]")
    wheel_radius: Range = Field(description="ratio of wheel radius to track [-]")
    torque: Range = Field(description="ratio of stall torque to that of the scaled robot [-]")
    top_speed: Range = Field(description="ratio of maximum speed to the speed of the faster wheels on the paths [-]")
    driven: WheelShares = Field(description="relative frequencies of wheel types")
    centre_of_mass: Range = Field(description="offset from the centre, divided by wheel base and track [-]")
    rolling_radii: Range = Field(description="relative difference between left and right radius [-]")
    motor_spread: Range = Field(description="ratio of the torque of each motor to nominal torque [-]")
    weak_motor: DrawnWeakMotor = Field(description="weak motor")
    dead_motor: DeadMotor = Field(description="failing motor")
    dead_time: Range = Field(description="dead time of the link [s]")
    lag: Range = Field(description="lag of each channel of the firmware [s]")
    skid_correction: Range = Field(
        description="share of the increase of the effective track that firmware compensates [-]"
    )
    friction: Range = Field(description="friction of the surface, log-uniform [-]")
    patches: Patches = Field(description="patches with different friction")
    slope: Slopes = Field(description="slopes")
    pose: PoseSources = Field(description="pose sources")
    stated: StatedRobot = Field(description="data stated by the user")
    needs: Needs = Field(description="requirements of the paths")
    turning_point: Positive = Field(
        description="ratio of the offset of the centre of rotation to that of the centre of mass [-]"
    )
    margin: Positive = Field(description="safety factor of required grip, torque and commands [-]")


@cache
def load_market() -> Market:
    """Read the market of the package; raise ConfigError if it is invalid."""
    return load_checked(Market, _FILE)


GRAVITY = 9.81
"""Gravitational acceleration for market robots [m/s^2]."""


@dataclass(frozen=True)
class DrawnRobot:
    """Random robot of the market.

    Attributes
    ----------
    seed
        Seed of the draw.
    build
        Body, drives, firmware, surface and sensors.
    scenario
        Slope, patches and motors of this robot.
    stated
        Configuration values that the user states, by dotted key; the tracks may be wrong.
    truth
        Configuration values with true tracks.
    """

    seed: int
    build: SimulatedRobot
    scenario: Scenario
    stated: Mapping[str, float]
    truth: Mapping[str, float]


def driven_weight_share(build: SimulatedRobot) -> float:
    """Compute the share of the weight that is on the driven wheels [-]."""
    chassis = build.twin.chassis
    return 1.0 + chassis.centre_of_mass[0] / chassis.wheel_base if chassis.castors else 1.0


def yaw_acceleration(build: SimulatedRobot, grip: float) -> float:
    """Compute the yaw acceleration [rad/s^2] that driven wheels with friction `grip` give a box of the robot's size."""
    chassis, track = build.twin.chassis, build.robot.track
    offset = chassis.centre_of_mass[0] if chassis.castors else 0.0
    # Inertia of a homogeneous box per mass, about a centre of rotation at the distance `offset` from its centre.
    inertia = (chassis.wheel_base**2 + track**2) / 12.0 + offset**2
    return grip * GRAVITY * driven_weight_share(build) * track / 2.0 / inertia


def skid_track(track: float, wheel_base: float) -> float:
    """Compute the effective track [m] of a robot that skids with Coulomb friction about the centre of its wheels."""
    return track * (1.0 + (wheel_base / track) ** 2)


def rim_speed(track: float, wheel_base: float) -> float:
    """Compute the speed of the faster wheels on the benchmark paths [m/s]."""
    needs = load_market().needs
    return needs.speed + 0.5 * needs.turning * skid_track(track, wheel_base)


def draw_robot(seed: int) -> DrawnRobot:
    """Draw the robot of the non-negative `seed`; the result depends only on the seed."""
    market, stream = load_market(), np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(4711,)))
    build = _draw_build(market, stream, f"robot {seed} of the market")
    scenario: dict[str, Any] = {"description": "disturbances of the drawn robot", "patches": [], "slope": None}
    castors = build["twin"]["chassis"]["castors"]
    build["twin"]["motor"]["spread"], scenario["weak_motors"] = _draw_motors(market, stream, castors=castors)
    build["friction"] = _logarithmic(stream, market.friction)
    # Values are drawn even for disturbances that this robot does not have, so that the numbers drawn afterwards do not
    # depend on the disturbances.
    patch = {name: _uniform(stream, getattr(market.patches, name)) for name in ("start", "length", "factor")}
    if stream.random() < market.patches.often:
        scenario["patches"] = [patch]
    has_slope = stream.random() < market.slope.often
    slope = {"angle": _uniform(stream, market.slope.angle), "downhill": _uniform(stream, (-math.pi, math.pi))}
    if has_slope:
        scenario["slope"] = slope
    twin = digital_twin()
    default: Any = twin["robot"]
    build["sensors"] = {"pose": _draw_pose_source(market.pose, stream, default["sample_time"])}
    factor = _uniform(stream, market.stated.track.factor)
    factor = factor if stream.random() < market.stated.track.wrong else 1.0
    build["twin"]["motor"]["stall_torque"] *= _uniform(stream, market.torque)
    where = f"market.yaml, seed {seed}"
    robot = check(SimulatedRobot, merge_mappings(twin, build), where)
    truth = _true_settings(robot)
    stated = truth | {name: factor * truth[name] for name in ("wheels.track", "wheels.encoder_track")}
    return DrawnRobot(seed, robot, check(Scenario, scenario, where), stated, truth)


def _draw_build(market: Market, stream: np.random.Generator, description: str) -> dict[str, Any]:
    """Draw body, drives, link and firmware as changes of the digital twin; the motors are scaled with the robot."""
    twin = digital_twin()
    default_robot: Any = twin["robot"]
    default: Any = twin["twin"]
    mass = _logarithmic(stream, market.mass)
    # Geometric similarity: lengths grow with the cube root of the mass.
    track = default_robot["track"] * (mass / default_robot["mass"]) ** (1 / 3) * _uniform(stream, market.track)
    wheel_base = track * _uniform(stream, market.wheel_base)
    radius = track * _uniform(stream, market.wheel_radius)
    castors = bool(stream.random() < market.driven.castors / (market.driven.castors + market.driven.wheels_4))
    skidding_base = 0.0 if castors else wheel_base
    no_load = _uniform(stream, market.top_speed) * rim_speed(track, skidding_base) / radius
    # With castors the origin is at the driven axle; the castors behind it carry 30 % of the weight on average.
    ahead = _uniform(stream, market.centre_of_mass) * wheel_base - (0.3 * wheel_base if castors else 0.0)
    left = _uniform(stream, market.centre_of_mass) * track
    difference = _uniform(stream, market.rolling_radii) / 2
    correction = _uniform(stream, market.skid_correction)
    radius_ratio, mass_ratio = radius / default_robot["wheel_radius"], mass / default_robot["mass"]
    speed_ratio = default["motor"]["no_load_speed"] / no_load
    return {
        "description": description,
        "robot": {"mass": mass, "track": track, "wheel_radius": radius},
        "twin": {
            "chassis": {
                "wheel_base": wheel_base,
                "body_size": [wheel_base + radius, 0.8 * track, 0.3 * track],
                "body_height": 0.1 * track,
                "wheel_mass": default["chassis"]["wheel_mass"] * mass_ratio,
                "centre_of_mass": [ahead, left],
                "rolling_radii": [1.0 - difference, 1.0 + difference],
                "castors": castors,
            },
            "motor": {
                "stall_torque": default["motor"]["stall_torque"] * mass_ratio * radius_ratio,
                "no_load_speed": no_load,
                # Torque scales with mass times length, inertia with mass times length squared.
                "rotor_inertia": default["motor"]["rotor_inertia"] * mass_ratio * radius_ratio**2,
            },
            # Gains are duty per speed, and full duty corresponds to the no-load speed.
            "driver": {gain: default["driver"][gain] * speed_ratio for gain in ("proportional_gain", "integral_gain")},
            "link": {"dead_time": _uniform(stream, market.dead_time)},
        },
        "firmware": {
            "lag_v": _uniform(stream, market.lag),
            "lag_omega": _uniform(stream, market.lag),
            "track": track + correction * (skid_track(track, skidding_base) - track),
        },
    }


def _true_settings(build: SimulatedRobot) -> dict[str, float]:
    """Compute the true configuration values by dotted key, for a horizontal surface without patches."""
    pose, link, default = build.sensors.pose, build.twin.link, digital_twin()
    default_twin: Any = default["twin"]
    default_robot: Any = default["robot"]
    extra = max(0.0, link.dead_time - default_twin["link"]["dead_time"])
    interval = pose.period / (1.0 - pose.loss) if pose.period else 0.0
    slew = load_market().stated.yaw_acceleration * yaw_acceleration(build, float(build.friction or 0.0))
    return {
        "wheels.track": build.firmware.track,
        "wheels.encoder_track": build.robot.track,
        "limits.wheel_speed": 0.97 * build.twin.motor.no_load_speed * build.robot.wheel_radius,
        "limits.omega_slew": min(default_robot["command_slew"]["omega"], slew),
        "extra_dead_time.v": extra,
        "extra_dead_time.omega": extra,
        "estimator.history": max(0.4, 1.3 * pose.latency + 0.1),
        "failure.max_pose_age": max(0.5, pose.latency + 5 * interval),
    }


def _uniform(stream: np.random.Generator, ends: tuple[float, float]) -> float:
    return float(stream.uniform(*ends))


def _logarithmic(stream: np.random.Generator, ends: tuple[float, float]) -> float:
    return math.exp(_uniform(stream, (math.log(ends[0]), math.log(ends[1]))))


def _draw_motors(
    market: Market, stream: np.random.Generator, *, castors: bool
) -> tuple[list[float], list[dict[str, Any]]]:
    """Draw torque ratios and failures of motors; robots with castors have no failures, since two wheels are driven."""
    spread = [_uniform(stream, market.motor_spread) for _ in WHEELS]
    weak, dead = market.weak_motor, market.dead_motor
    weak_wheel, weak_factor = int(stream.integers(2 if castors else 4)), _uniform(stream, weak.factor)
    if stream.random() < weak.often:
        spread[weak_wheel] *= weak_factor
    dead_wheel, failure_time = int(stream.integers(4)), _uniform(stream, dead.start)
    has_failure = stream.random() < dead.often and not castors
    return spread, [{"wheel": WHEELS[dead_wheel], "factor": 0.0, "start": failure_time}] if has_failure else []


def _draw_pose_source(ranges: PoseSources, stream: np.random.Generator, sample_time: float) -> dict[str, Any]:
    """Draw a pose sensor; all values have a common random quality, from which each value deviates randomly."""
    quality = stream.random()

    def draw(ends: tuple[float, float]) -> float:
        share = np.clip(quality + ranges.jitter * stream.uniform(-1.0, 1.0), 0.0, 1.0)
        best, worst = np.log(ends)
        return float(np.exp(best + share * (worst - best)))

    values: dict[str, Any] = {name: draw(getattr(ranges, name)) for name in ("latency", "position_sd", "heading_sd")}
    period, loss = 1.0 / draw(ranges.rate), _uniform(stream, ranges.loss)
    has_loss = stream.random() < 0.5
    return {**values, "period": period if period > sample_time else None, "loss": loss if has_loss else 0.0}
