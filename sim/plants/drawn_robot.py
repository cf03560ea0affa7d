"""A robot of the market, drawn from a seed: build, floor, what befalls it, pose source, and what its user states."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from diffdrive_mpc.models.checked_yaml import StrictModel, check, laid_over, load_checked
from diffdrive_mpc.models.robot import NotNegative, Positive
from diffdrive_mpc.sim.disturbances.scenario import Scenario
from diffdrive_mpc.sim.plants.chassis import WHEELS
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot, digital_twin

# What robots on the market are like: the ranges that a robot of the population is drawn from, and what paths need.


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


class DrawnWeakMotor(StrictModel):
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


class StatedRobot(StrictModel):
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


RESERVED = 2
"""Seeds that are a multiple of it are never used for tuning: results are reported on them."""
_GRAVITY = 9.81


@dataclass(frozen=True)
class DrawnRobot:
    """One robot of the population.

    Attributes
    ----------
    seed
        What it was drawn from.
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

    def can_drive(self, spot_turns: bool = False) -> bool:
        """Whether it can drive the benchmark paths, by a rule that knows its physics and no controller.

        Grip holds it on the slope, moves it sideways and turns it as the paths ask; motors push it uphill while their
        wheels skid; the yaw rate to command is below the limit. With `spot_turns` the path turns on the spot, which a
        robot that turns about another point cannot do.
        """
        market = load_market()
        ahead = 0.0 if self.build.twin.chassis.castors else abs(self.build.twin.chassis.centre_of_mass[0])
        turns_aside = market.turning_point * ahead > market.needs.turning_point
        return self._grips() and self._pushes() and self._answers() and not (spot_turns and turns_aside)

    @property
    def _grip(self) -> float:
        """Friction coefficient of the worst floor on its way."""
        usual = float(self.build.friction or 0.0)
        return min([usual, *(patch.coefficient(usual) for patch in self.scenario.patches)])

    @property
    def _slope(self) -> float:
        """Slope of its floor [rad]."""
        return self.scenario.slope.angle if self.scenario.slope else 0.0

    @property
    def _skidding_base(self) -> float:
        """Wheel base of the wheels that skid sideways in a turn [m]: castors do not."""
        return 0.0 if self.build.twin.chassis.castors else self.build.twin.chassis.wheel_base

    def _climb(self) -> float:
        """Force along the way on the slope, over its weight across: the slope, and the reference's acceleration."""
        return math.tan(self._slope) + load_market().needs.acceleration / _GRAVITY / math.cos(self._slope)

    def _grips(self) -> bool:
        """Whether grip holds it on the slope while it speeds up, and gives it the yaw acceleration of the paths."""
        market = load_market()
        turned = market.stated.yaw_acceleration * _yaw_acceleration(self.build, self._grip)
        return (
            self._grip * _on_driven(self.build) > market.margin * self._climb()
            and turned > market.needs.yaw_acceleration
        )

    def _pushes(self) -> bool:
        """Whether the motors of the more loaded side push it uphill and skid their wheels, at the speed they need."""
        chassis, robot = self.build.twin.chassis, self.build.robot
        base, track, left = self._skidding_base, robot.track, chassis.centre_of_mass[1]
        load = robot.mass * _GRAVITY * (0.5 + abs(left) / track)
        needed = load * (self._climb() + self._grip * base / math.hypot(base, track))
        return min(self._side_forces()) > load_market().margin * needed

    def _answers(self) -> bool:
        """Whether the yaw rate to command is below its limit, and its speed answers while its wheels skid in a turn.

        A slope moves the robot by its share of the grip.
        """
        market, track, base = load_market(), self.build.robot.track, self._skidding_base
        needs = market.needs
        command = needs.turning * _skid_track(track, base) / self.build.firmware.track
        skid = _skid_speed(needs.turning, track, base)
        return (
            market.margin * command < self.build.robot.limits.omega
            and skid * math.tan(self._slope) / self._grip < needs.sliding * needs.speed
            and skidding_time(needs.turning, track, base, self._grip) < needs.skid_time
        )

    def _side_forces(self) -> tuple[float, float]:
        """Force of the left and of the right motors at the speed that the paths ask of the faster wheels [N]."""
        robot, motor, castors = self.build.robot, self.build.twin.motor, self.build.twin.chassis.castors
        rim = _rim_speed(robot.track, self._skidding_base)
        left = 1.0 - rim / (motor.no_load_speed * robot.wheel_radius)
        factors = dict.fromkeys(WHEELS, 1.0) | {weak.wheel: weak.factor for weak in self.scenario.weak_motors}
        forces = [
            0.0 if castors and wheel.startswith("rear") else share * factors[wheel] * left * motor.stall_torque
            for wheel, share in zip(WHEELS, motor.spread, strict=True)
        ]
        return (forces[0] + forces[2]) / robot.wheel_radius, (forces[1] + forces[3]) / robot.wheel_radius


@cache
def _driving_seeds(spot_turns: bool, tuning: bool) -> tuple[Iterator[int], list[int]]:
    """Seeds of robots that can drive, in order, and the list of those that were found so far."""
    seeds = itertools.count(1 if tuning else 0, RESERVED)
    return (seed for seed in seeds if draw_robot(seed).can_drive(spot_turns)), []


def driving_seeds(count: int, *, spot_turns: bool, tuning: bool = False) -> list[int]:
    """Seeds of the first `count` reserved robots that can drive a path, see `DrawnRobot.can_drive`.

    With `tuning` the first of those whose seeds are not reserved.
    """
    more, seeds = _driving_seeds(spot_turns, tuning)
    seeds.extend(itertools.islice(more, max(0, count - len(seeds))))
    return seeds[:count]


def _on_driven(build: SimulatedRobot) -> float:
    """Share of the weight on driven wheels."""
    chassis = build.twin.chassis
    return 1.0 + chassis.centre_of_mass[0] / chassis.wheel_base if chassis.castors else 1.0


def _yaw_acceleration(build: SimulatedRobot, grip: float) -> float:
    """Yaw acceleration that driven wheels give a box of its size on a floor of this friction [rad/s^2]."""
    chassis, track = build.twin.chassis, build.robot.track
    behind = chassis.centre_of_mass[0] if chassis.castors else 0.0
    inertia = (chassis.wheel_base**2 + track**2) / 12.0 + behind**2
    return grip * _GRAVITY * _on_driven(build) * track / 2.0 / inertia


def _skid_speed(yaw_rate: float, track: float, wheel_base: float) -> float:
    """Speed at which wheels skid in a turn [m/s]: Coulomb friction, the wheels' middle as its centre."""
    return yaw_rate * math.hypot(wheel_base / 2, wheel_base**2 / track / 2)


def skidding_time(yaw_rate: float, track: float, wheel_base: float, friction: float) -> float:
    """Time constant of the speed of a robot whose wheels skid in a turn [s].

    Coulomb friction points against the skid, so that a force along the way only turns it.
    """
    skid = _skid_speed(yaw_rate, track, wheel_base)
    return skid * (1.0 + (wheel_base / track) ** 2) / (friction * _GRAVITY)


def _skid_track(track: float, wheel_base: float) -> float:
    """Track of the wheels that turn a skidding robot [m]: Coulomb friction, the wheels' middle as its centre."""
    return track * (1.0 + (wheel_base / track) ** 2)


def _rim_speed(track: float, wheel_base: float) -> float:
    """Speed of the faster wheels on the benchmark paths [m/s]."""
    needs = load_market().needs
    return needs.speed + 0.5 * needs.turning * _skid_track(track, wheel_base)


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
    robot = check(SimulatedRobot, laid_over(twin, build), where)
    truth = _true_settings(robot)
    stated = truth | {name: factor * truth[name] for name in ("wheels.track", "wheels.encoder_track")}
    return DrawnRobot(seed, robot, check(Scenario, befalls, where), stated, truth)


def _draw_build(market: Market, stream: np.random.Generator, description: str) -> dict[str, Any]:
    """Body, drives, link and firmware, as changes to the digital twin; torques as of its scaled motors."""
    twin = digital_twin()
    usual_robot: Any = twin["robot"]
    usual: Any = twin["twin"]
    mass = _logarithmic(stream, market.mass)
    track = usual_robot["track"] * (mass / usual_robot["mass"]) ** (1 / 3) * _uniform(stream, market.track)
    wheel_base = track * _uniform(stream, market.wheel_base)
    radius = track * _uniform(stream, market.wheel_radius)
    castors = bool(stream.random() < market.driven.castors / (market.driven.castors + market.driven.wheels_4))
    skidding_base = 0.0 if castors else wheel_base
    no_load = _uniform(stream, market.top_speed) * _rim_speed(track, skidding_base) / radius
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
            "track": track + correction * (_skid_track(track, skidding_base) - track),
        },
    }


def _true_settings(build: SimulatedRobot) -> dict[str, float]:
    """Configuration values of a robot whose user knows it, by dotted key; of patches and slopes nobody knows."""
    pose, link, usual = build.sensors.pose, build.twin.link, digital_twin()
    usual_twin: Any = usual["twin"]
    usual_robot: Any = usual["robot"]
    later = max(0.0, link.dead_time - usual_twin["link"]["dead_time"])
    every = pose.period / (1.0 - pose.loss) if pose.period else 0.0
    turned = load_market().stated.yaw_acceleration * _yaw_acceleration(build, float(build.friction or 0.0))
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
    """Torque of each motor over nominal, and the motors that fail on the way; castors have none to spare."""
    spread = [_uniform(stream, market.motor_spread) for _ in WHEELS]
    weak, dead = market.weak_motor, market.dead_motor
    weak_wheel, weak_factor = int(stream.integers(2 if castors else 4)), _uniform(stream, weak.factor)
    if stream.random() < weak.often:
        spread[weak_wheel] *= weak_factor
    dead_wheel, dead_from = int(stream.integers(4)), _uniform(stream, dead.start)
    dies = stream.random() < dead.often and not castors
    return spread, [{"wheel": WHEELS[dead_wheel], "factor": 0.0, "start": dead_from}] if dies else []


def _draw_pose_source(ranges: PoseSources, stream: np.random.Generator, sample_time: float) -> dict[str, Any]:
    """The pose sensor's values: a common quality, and each beside it."""
    quality = stream.random()

    def at(ends: tuple[float, float]) -> float:
        share = np.clip(quality + ranges.jitter * stream.uniform(-1.0, 1.0), 0.0, 1.0)
        best, worst = np.log(ends)
        return float(np.exp(best + share * (worst - best)))

    values: dict[str, Any] = {name: at(getattr(ranges, name)) for name in ("latency", "position_sd", "heading_sd")}
    period, loss = 1.0 / at(ranges.rate), _uniform(stream, ranges.loss)
    lossy = stream.random() < 0.5
    return {**values, "period": period if period > sample_time else None, "loss": loss if lossy else 0.0}
