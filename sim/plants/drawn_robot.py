"""A robot of the market, drawn from a seed: build, floor, what befalls it, pose source, and what its user states."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import check, laid_over, read_yaml
from diffdrive_mpc.sim.disturbances.scenario import Scenario
from diffdrive_mpc.sim.plants.chassis import WHEELS
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot, digital_twin

RESERVED = 2
"""Seeds that are a multiple of it are never used for tuning: results are reported on them."""
_GRAVITY = 9.81
_FILE = Path(__file__).with_name("market.yaml")


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

        Friction holds it on the slope while it speeds up. While wheels skid in a turn a force moves the robot by its
        share of the grip, and its speed answers with a time constant, skidding speed over friction: both are small
        enough to steer. The motors of the more heavily loaded side push it uphill, and skid their wheels sideways, at
        the speed that the path asks of them: torque falls linearly with speed. The yaw rate to command is below the
        limit.
        With `spot_turns` the path turns on the spot, which a robot that turns about another point cannot do.
        """
        market, robot, chassis = _market(), self.build.robot, self.build.twin.chassis
        needs, margin, grip = market["needs"], market["margin"], float(self.build.friction or 0.0)
        slope = self.scenario.slope.angle if self.scenario.slope else 0.0
        for patch in self.scenario.patches:
            grip = min(grip, patch.coefficient(float(self.build.friction or 0.0)))
        base, track = (0.0 if chassis.castors else chassis.wheel_base), robot.track
        ahead, left = chassis.centre_of_mass
        on_driven = 1.0 + ahead / chassis.wheel_base if chassis.castors else 1.0
        push = math.tan(slope) + needs["acceleration"] / _GRAVITY / math.cos(slope)
        skid = needs["turning"] * math.hypot(base / 2, base**2 / track / 2)
        needed = robot.mass * _GRAVITY * (0.5 + abs(left) / track) * (push + grip * base / math.hypot(base, track))
        command = needs["turning"] * _skid_track(track, base) / self.build.firmware.track
        turns_about = 0.0 if chassis.castors else market["turning_point"] * abs(ahead)
        return bool(
            grip * on_driven > margin * push
            and min(self._side_forces()) > margin * needed
            and margin * command < robot.limits.omega
            and skid * math.tan(slope) / grip < needs["sliding"] * needs["speed"]
            and skid / (grip * _GRAVITY) < needs["skid_time"]
            and not (spot_turns and turns_about > needs["turning_point"])
        )

    def _side_forces(self) -> tuple[float, float]:
        """Force of the left and of the right motors at the speed that the paths ask of the faster wheels [N]."""
        robot, motor, castors = self.build.robot, self.build.twin.motor, self.build.twin.chassis.castors
        left = 1.0 - _rim_speed(self.build) / (motor.no_load_speed * robot.wheel_radius)
        factors = dict.fromkeys(WHEELS, 1.0) | {weak.wheel: weak.factor for weak in self.scenario.weak_motors}
        forces = [
            0.0 if castors and wheel.startswith("rear") else share * factors[wheel] * left * motor.stall_torque
            for wheel, share in zip(WHEELS, motor.spread, strict=True)
        ]
        return (forces[0] + forces[2]) / robot.wheel_radius, (forces[1] + forces[3]) / robot.wheel_radius


@cache
def _market() -> dict[str, Any]:
    data: dict[str, Any] = read_yaml(_FILE)
    return data


def _rim_speed(build: SimulatedRobot) -> float:
    """Speed of the faster wheels on the benchmark paths [m/s]."""
    needs = _market()["needs"]
    return float(
        needs["speed"] + 0.5 * needs["turning"] * _skid_track(build.robot.track, build.twin.chassis.wheel_base)
    )


def _skid_track(track: float, wheel_base: float) -> float:
    """Track of the wheels that turn a skidding robot [m]: Coulomb friction, the wheels' middle as its centre."""
    return track * (1.0 + (wheel_base / track) ** 2)


def draw_robot(seed: int) -> DrawnRobot:
    """Draw the robot of `seed` (not negative); the same seed gives the same one."""
    market, stream = _market(), np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(4711,)))

    def uniform(span: list[float]) -> float:
        return _uniform(stream, span)

    def logarithmic(span: list[float]) -> float:
        return float(np.exp(_uniform(stream, np.log(span).tolist())))

    twin = digital_twin()
    like = {name: twin[name] for name in ("robot", "twin")}
    usual_robot: Any = like["robot"]
    usual_twin: Any = like["twin"]
    mass = logarithmic(market["mass"])
    scale = (mass / usual_robot["mass"]) ** (1 / 3)
    track = usual_robot["track"] * scale * uniform(market["track"])
    wheel_base = track * uniform(market["wheel_base"])
    radius = track * uniform(market["wheel_radius"])
    often = market["driven"]
    castors = bool(stream.random() < often["castors"] / sum(often.values()))
    skid = track if castors else _skid_track(track, wheel_base)
    needs = market["needs"]
    rim = needs["speed"] + 0.5 * needs["turning"] * skid
    no_load = uniform(market["top_speed"]) * rim / radius
    quick = usual_twin["motor"]["no_load_speed"] / no_load
    larger = radius / usual_robot["wheel_radius"]
    heavy = mass / usual_robot["mass"] * larger
    ahead, left = uniform(market["centre_of_mass"]) * wheel_base, uniform(market["centre_of_mass"]) * track
    difference = uniform(market["rolling_radii"]) / 2
    correction = uniform(market["skid_correction"])
    firmware_track = track + correction * (skid - track)
    dead_time, lag_v, lag_omega = uniform(market["dead_time"]), uniform(market["lag"]), uniform(market["lag"])
    spread, failing = _motors(market, stream, castors=castors)
    friction = logarithmic(market["friction"])
    patches = market["patches"]
    patch = {name: uniform(patches[name]) for name in ("start", "length", "factor")}
    patched = stream.random() < patches["often"]
    sloped = stream.random() < market["slope"]["often"]
    slope = {"angle": uniform(market["slope"]["angle"]), "downhill": uniform([-math.pi, math.pi])}
    pose = _pose_source(market["pose"], stream, usual_robot["sample_time"])
    wrong = market["stated"]["track"]
    track_factor = uniform(wrong["factor"])
    track_factor = track_factor if stream.random() < wrong["wrong"] else 1.0
    build = laid_over(
        twin,
        {
            "description": f"robot {seed} of the market",
            "robot": {"mass": mass, "track": track, "wheel_radius": radius},
            "twin": {
                "chassis": {
                    "wheel_base": wheel_base,
                    "body_size": [wheel_base + radius, 0.8 * track, 0.3 * track],
                    "body_height": 0.1 * track,
                    "wheel_mass": usual_twin["chassis"]["wheel_mass"] * mass / usual_robot["mass"],
                    "centre_of_mass": [ahead - (0.3 * wheel_base if castors else 0.0), left],
                    "rolling_radii": [1.0 - difference, 1.0 + difference],
                    "castors": castors,
                },
                "motor": {
                    "stall_torque": usual_twin["motor"]["stall_torque"] * heavy * uniform(market["torque"]),
                    "no_load_speed": no_load,
                    "rotor_inertia": usual_twin["motor"]["rotor_inertia"]
                    * heavy
                    * radius
                    / usual_robot["wheel_radius"],
                    "spread": spread,
                },
                "driver": {
                    "proportional_gain": usual_twin["driver"]["proportional_gain"] * quick,
                    "integral_gain": usual_twin["driver"]["integral_gain"] * quick,
                },
                "link": {"dead_time": dead_time},
            },
            "firmware": {"lag_v": lag_v, "lag_omega": lag_omega, "track": firmware_track},
            "friction": friction,
            "sensors": {"pose": pose},
        },
    )
    scenario = {
        "description": "what befalls it",
        "slope": slope if sloped else None,
        "patches": [patch] if patched else [],
        "weak_motors": failing,
    }
    late = pose["period"] / (1.0 - pose["loss"]) if pose["period"] else 0.0
    truth = {
        "wheels.track": firmware_track,
        "wheels.encoder_track": track,
        "limits.wheel_speed": 0.97 * no_load * radius,
        "extra_dead_time.v": max(0.0, dead_time - usual_twin["link"]["dead_time"]),
        "extra_dead_time.omega": max(0.0, dead_time - usual_twin["link"]["dead_time"]),
        "estimator.history": max(0.4, 1.3 * pose["latency"] + 0.1),
        "failure.max_pose_age": max(0.5, pose["latency"] + 5 * late),
    }
    stated = truth | {name: track_factor * truth[name] for name in ("wheels.track", "wheels.encoder_track")}
    where = f"{_FILE.name}, seed {seed}"
    return DrawnRobot(seed, check(SimulatedRobot, build, where), check(Scenario, scenario, where), stated, truth)


def _uniform(stream: np.random.Generator, span: list[float]) -> float:
    return float(stream.uniform(span[0], span[1]))


def _motors(
    market: dict[str, Any], stream: np.random.Generator, *, castors: bool
) -> tuple[list[float], list[dict[str, Any]]]:
    """Torque of each motor over nominal, and the motors that fail on the way; castors have none to spare."""
    spread = [_uniform(stream, market["motor_spread"]) for _ in WHEELS]
    weak, dead = market["weak_motor"], market["dead_motor"]
    weak_wheel, weak_factor = int(stream.integers(2 if castors else 4)), _uniform(stream, weak["factor"])
    if stream.random() < weak["often"]:
        spread[weak_wheel] *= weak_factor
    dead_wheel, dead_from = int(stream.integers(4)), _uniform(stream, dead["start"])
    dies = stream.random() < dead["often"] and not castors
    return spread, [{"wheel": WHEELS[dead_wheel], "factor": 0.0, "start": dead_from}] if dies else []


def _pose_source(ranges: dict[str, Any], stream: np.random.Generator, sample_time: float) -> dict[str, Any]:
    """The pose sensor's values: a common quality, and each beside it."""
    quality = stream.random()

    def at(name: str) -> float:
        share = np.clip(quality + ranges["jitter"] * stream.uniform(-1.0, 1.0), 0.0, 1.0)
        best, worst = np.log(ranges[name])
        return float(np.exp(best + share * (worst - best)))

    values: dict[str, Any] = {name: at(name) for name in ("latency", "position_sd", "heading_sd")}
    period, loss = 1.0 / at("rate"), _uniform(stream, ranges["loss"])
    lossy = stream.random() < 0.5
    return {**values, "period": period if period > sample_time else None, "loss": loss if lossy else 0.0}
