"""Robots of the population that can drive the benchmark paths, selected by physical conditions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

from diffdrive_mpc.sim.plants.chassis import WHEELS
from diffdrive_mpc.sim.plants.drawn_robot import (
    GRAVITY,
    DrawnRobot,
    draw_robot,
    driven_weight_share,
    load_market,
    rim_speed,
    skid_track,
    yaw_acceleration,
)

RESERVED = 2
"""Seeds that are multiples of this value are reserved for results and never used for tuning."""


def can_drive(robot: DrawnRobot, spot_turns: bool = False) -> bool:
    """Return True if a robot can drive the benchmark paths.

    The grip must suffice for the slope and the yaw acceleration of the paths, the motor torque for the slope with
    skidding wheels, and the commanded yaw rate must be below its limit. With `spot_turns` the paths contain turns on
    the spot, which a robot with a distant turning point cannot drive.
    """
    market, chassis, rule = load_market(), robot.build.twin.chassis, _Rule(robot)
    distance = 0.0 if chassis.castors else abs(chassis.centre_of_mass[0])
    turns_off_centre = market.turning_point * distance > market.needs.turning_point
    return rule.has_grip() and rule.has_torque() and rule.has_response() and not (spot_turns and turns_off_centre)


def driving_seeds(count: int, *, spot_turns: bool, tuning: bool = False) -> list[int]:
    """Return the seeds of the first `count` reserved robots that can drive a path.

    With `tuning`, the seeds are those of the first robots that are not reserved.
    """
    remaining, seeds = _driving_seeds(spot_turns, tuning)
    seeds.extend(itertools.islice(remaining, max(0, count - len(seeds))))
    return seeds[:count]


@cache
def _driving_seeds(spot_turns: bool, tuning: bool) -> tuple[Iterator[int], list[int]]:
    """Return an iterator over the seeds of drivable robots, and the list of seeds returned so far."""
    seeds = itertools.count(1 if tuning else 0, RESERVED)
    return (seed for seed in seeds if can_drive(draw_robot(seed), spot_turns)), []


@dataclass(frozen=True)
class _Rule:
    """Conditions for one robot."""

    robot: DrawnRobot

    def has_grip(self) -> bool:
        """Return True if the grip suffices for acceleration on the slope and for the yaw acceleration of the paths."""
        market, build = load_market(), self.robot.build
        acceleration = market.stated.yaw_acceleration * yaw_acceleration(build, self._grip)
        return (
            self._grip * driven_weight_share(build) > market.margin * self._climb()
            and acceleration > market.needs.yaw_acceleration
        )

    def has_torque(self) -> bool:
        """Return True if the motors of the more loaded side can climb the slope with skidding wheels at speed."""
        chassis, robot = self.robot.build.twin.chassis, self.robot.build.robot
        base, track, left = self._skidding_base, robot.track, chassis.centre_of_mass[1]
        load = robot.mass * GRAVITY * (0.5 + abs(left) / track)
        needed = load * (self._climb() + self._grip * base / math.hypot(base, track))
        return min(self._side_forces()) > load_market().margin * needed

    def has_response(self) -> bool:
        """Return True if the commanded yaw rate is below its limit and the speed is controllable with skidding wheels.

        A slope causes a drift in proportion to its part of the grip.
        """
        market, build, base = load_market(), self.robot.build, self._skidding_base
        needs, track = market.needs, build.robot.track
        command = needs.turning * skid_track(track, base) / build.firmware.track
        skid = _skid_speed(needs.turning, track, base)
        return (
            market.margin * command < build.robot.limits.omega
            and skid * math.tan(self._slope) / self._grip < needs.sliding * needs.speed
            and skidding_time(needs.turning, track, base, self._grip) < needs.skid_time
        )

    @property
    def _grip(self) -> float:
        """Minimum friction coefficient on the path."""
        usual = float(self.robot.build.friction or 0.0)
        return min([usual, *(patch.coefficient(usual) for patch in self.robot.scenario.patches)])

    @property
    def _slope(self) -> float:
        """Slope of the surface [rad]."""
        return self.robot.scenario.slope.angle if self.robot.scenario.slope else 0.0

    @property
    def _skidding_base(self) -> float:
        """Wheel base of the wheels that skid laterally in a turn [m]; zero for a robot with castors."""
        chassis = self.robot.build.twin.chassis
        return 0.0 if chassis.castors else chassis.wheel_base

    def _climb(self) -> float:
        """Return the ratio of the force along the path, for slope and acceleration, to the normal force."""
        return math.tan(self._slope) + load_market().needs.acceleration / GRAVITY / math.cos(self._slope)

    def _side_forces(self) -> tuple[float, float]:
        """Return the forces of the left and right motors at the maximum wheel speed of the paths [N]."""
        build, motor = self.robot.build, self.robot.build.twin.motor
        robot, castors = build.robot, build.twin.chassis.castors
        torque_ratio = 1.0 - rim_speed(robot.track, self._skidding_base) / (motor.no_load_speed * robot.wheel_radius)
        factors = dict.fromkeys(WHEELS, 1.0) | {fault.wheel: fault.factor for fault in self.robot.scenario.weak_motors}
        forces = [
            0.0 if castors and wheel.startswith("rear") else ratio * factors[wheel] * torque_ratio * motor.stall_torque
            for wheel, ratio in zip(WHEELS, motor.spread, strict=True)
        ]
        return (forces[0] + forces[2]) / robot.wheel_radius, (forces[1] + forces[3]) / robot.wheel_radius


def _skid_speed(yaw_rate: float, track: float, wheel_base: float) -> float:
    """Return the lateral speed of the wheels in a turn about the centre of the wheels [m/s], with Coulomb friction."""
    return yaw_rate * math.hypot(wheel_base / 2, wheel_base**2 / track / 2)


def skidding_time(yaw_rate: float, track: float, wheel_base: float, friction: float) -> float:
    """Return the time constant of the speed of a robot whose wheels skid in a turn [s].

    Coulomb friction opposes the skid velocity, so a force along the path only changes the direction of friction.
    """
    skid = _skid_speed(yaw_rate, track, wheel_base)
    return skid * (1.0 + (wheel_base / track) ** 2) / (friction * GRAVITY)
