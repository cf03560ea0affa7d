"""The rule by which robots of the market can drive a path."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_mpc.sim.plants.drawn_robot import draw_robot
from diffdrive_mpc_extras.campaign.drivable_robots import RESERVED, can_drive, driving_seeds, skidding_time

MANY = [draw_robot(seed) for seed in range(300)]


def test_the_rule_lets_a_third_drive_and_fewer_turn_on_the_spot():
    """Whoever may turn on the spot may drive; each of the rule's parts keeps somebody out."""
    drives = np.array([can_drive(robot) for robot in MANY])
    spot = np.array([can_drive(robot, spot_turns=True) for robot in MANY])
    assert 0.2 < drives.mean() < 0.6
    assert spot.sum() < drives.sum()
    assert not (spot & ~drives).any()
    icy = [robot for robot, may in zip(MANY, drives, strict=True) if may and robot.scenario.slope]
    assert all(np.tan(robot.scenario.slope.angle) < robot.build.friction for robot in icy)


def test_the_speed_of_a_skidding_robot_answers_as_the_rule_says():
    """Four Coulomb wheels in a steady turn: what a little more speed of the wheels adds to the force along the way."""
    base, track, friction, yaw_rate, mass = 0.6, 0.5, 0.7, 0.5, 20.0

    def force(more: float) -> float:
        along = 0.0
        for side in (-1.0, 1.0):
            skid = np.array([side * yaw_rate * base**2 / track / 2 + more, yaw_rate * base / 2])
            along += 2 * friction * mass * 9.81 / 4 * skid[0] / np.linalg.norm(skid)
        return along

    slope = (force(1e-6) - force(-1e-6)) / 2e-6
    assert skidding_time(yaw_rate, track, base, friction) == pytest.approx(mass / slope, rel=1e-6)


def test_half_of_the_seeds_are_reserved():
    """Tuning takes odd seeds; the numbers of the sensor test say so beside them."""
    assert RESERVED == 2
    for tuning in (False, True):
        seeds = driving_seeds(20, spot_turns=True, tuning=tuning)
        assert {seed % RESERVED for seed in seeds} == {int(tuning)}
        drawn = range(int(tuning), seeds[-1] + 1, RESERVED)
        assert seeds == [seed for seed in drawn if can_drive(draw_robot(seed), spot_turns=True)]
