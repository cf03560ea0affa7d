"""Floors that drag, tilt or slip: forces and accelerations against mechanics."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from diffdrive_mpc import ConfigError, make_plant
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.disturbances.disturbance_types import Slope
from diffdrive_mpc.sim.disturbances.scenario import load_scenario
from diffdrive_mpc.sim.plants.chassis import Chassis
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.plants.twin_parameters import load_twin_parameters

GRAVITY = 9.81
ROBOT, TWIN = load_robot(), load_twin_parameters()
STEP = ROBOT.sample_time / TWIN.substeps


def _braked(chassis: Chassis, seconds: float) -> None:
    """Let time pass with wheels that hardly turn."""
    for _ in range(round(seconds / STEP)):
        chassis.step(-1.0 * chassis.wheel_speeds)


def _drag(surface: str, direction: float, heading: float = 0.5) -> float:
    """Friction coefficient of a robot with braked wheels that is dragged along the floor, from forward to the left."""
    floor = load_surface(surface)
    chassis = Chassis(ROBOT, TWIN, floor.friction or 0.0, STEP, sideways=floor.sideways)
    chassis.reset([0.0, 0.0, heading])
    # Not much more than needed: a robot that is torn away tips over.
    expected = (floor.friction or 0.0) * math.hypot(math.cos(direction), floor.sideways * math.sin(direction))
    force = 1.15 * expected * ROBOT.mass * GRAVITY
    chassis.push(force * math.cos(direction), force * math.sin(direction), 0.0, 0.0)
    _braked(chassis, 0.3)
    before = np.hypot(*chassis.twist[:2])
    _braked(chassis, 0.2)
    return float(force / ROBOT.mass - (np.hypot(*chassis.twist[:2]) - before) / 0.2) / GRAVITY


@pytest.mark.parametrize("surface", ["default", "carpet", "deep_carpet", "ice"])
def test_the_force_to_drag_it_is_that_of_the_friction_in_each_direction(surface: str) -> None:
    floor = load_surface(surface)
    assert floor.friction is not None
    along, across = _drag(surface, 0.0), _drag(surface, math.pi / 2)
    assert along == pytest.approx(floor.friction, rel=0.05)
    assert across == pytest.approx(floor.sideways_friction or floor.friction, rel=0.05)
    # However it stands in the world.
    assert _drag(surface, math.pi / 2, heading=2.0) == pytest.approx(across, rel=0.01)


@pytest.mark.parametrize("surface", ["default", "carpet", "deep_carpet"])
def test_a_carpet_keeps_it_from_turning_as_coulomb_friction_says(surface: str) -> None:
    """Moment balance of four sliding wheels whose friction is an ellipse: forces are as friction squared times slip."""
    ratio = load_surface(surface).sideways * TWIN.chassis.wheel_base / ROBOT.track
    log = drive_open_loop(make_plant("mujoco", surface, "perfect"), np.tile([0.0, 1.0], (150, 1)))
    gain = log.true_twist[75:, 2].mean() / log.wheel_twist[75:, 1].mean()
    assert gain == pytest.approx(1 / (1 + ratio**2), abs=0.01 if surface == "default" else 0.015)


def test_two_contact_points_a_wheel_are_as_good_as_one() -> None:
    """The capsules of a carpet with hardly any difference between its directions drive like the spheres."""
    floor = load_surface("default").friction or 0.0
    poses = []
    for sideways in (1.0, 1.0 + 1e-9):
        chassis = Chassis(ROBOT, TWIN, floor, STEP, sideways=sideways)
        for k in range(1000):
            target = np.array([3.0, 7.0, 3.0, 7.0]) * min(1.0, k / 200)
            chassis.step(0.5 * (target - chassis.wheel_speeds))
        assert chassis.wheels_on_floor == 4
        assert chassis.wheel_loads.sum() == pytest.approx(ROBOT.mass * GRAVITY, rel=0.02)
        poses.append(chassis.pose)
    assert poses[0][2] > 0.5
    np.testing.assert_allclose(poses[1], poses[0], rtol=0.01, atol=2e-3)


@pytest.mark.parametrize(("friction", "holds"), [(0.25, True), (0.1, False)])
def test_across_a_slope_of_ten_degrees_it_stays_or_slides_as_friction_says(friction: float, holds: bool) -> None:
    """Tangent of the angle 0.176: below that the acceleration is g (sin - friction cos), downhill."""
    angle = math.radians(10.0)
    chassis = Chassis(ROBOT, TWIN, friction, STEP, slope=Slope(angle=angle, downhill=math.pi / 2))
    _braked(chassis, 0.5)
    early = chassis.twist[1]
    _braked(chassis, 0.5)
    acceleration = (chassis.twist[1] - early) / 0.5
    if holds:
        # Soft contacts creep; they do not speed up.
        assert abs(acceleration) < 0.01
        assert 0 <= chassis.pose[1] < 0.2
    else:
        expected = GRAVITY * (math.sin(angle) - friction * math.cos(angle))
        assert acceleration == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("name", "downhill"), [("slope_10_up", (-1, 0)), ("slope_10_down", (1, 0)), ("slope_10_across", (0, 1))]
)
def test_the_steep_slopes_have_ten_degrees_and_fall_where_they_say(name: str, downhill: tuple[int, int]) -> None:
    """The force of the floor is the weight's part normal to it; a robot without motors moves downhill."""
    slope = load_scenario(name).draw(0).slope
    assert slope is not None
    chassis = Chassis(ROBOT, TWIN, 0.05, STEP, slope=slope)
    for _ in range(300):
        chassis.step(np.zeros(4))
    assert chassis.wheel_loads.sum() == pytest.approx(ROBOT.mass * GRAVITY * math.cos(math.radians(10.0)), rel=0.01)
    x, y, _ = chassis.pose
    assert x * downhill[0] + abs(y) * abs(downhill[1]) > 0.05
    assert abs(x * downhill[1]) + abs(y * downhill[0]) < 0.02


def test_a_patch_on_a_carpet_keeps_the_ratio_of_its_directions() -> None:
    plant = make_plant("mujoco", "carpet")
    assert isinstance(plant, MujocoPlant)
    plant.chassis.set_friction(np.full(4, 0.2))
    assert _coefficients(plant) == pytest.approx((0.3, 0.2))


def _coefficients(plant: MujocoPlant) -> tuple[float, float]:
    across, along = plant.chassis._model.pair_friction[0, :2]
    return float(across), float(along)


def test_a_floor_without_friction_has_none_sideways_either(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        "sideways_friction: 0.5\nslip: {yaw_gain: 1, wheel_yaw_gain: 1, longitudinal_gain: 1, side_slip: 0}\n"
    )
    with pytest.raises(ConfigError, match=r"mine\.yaml: sideways_friction: give friction, along the rolling direction"):
        load_surface(path)
