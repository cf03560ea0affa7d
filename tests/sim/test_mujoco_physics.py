"""The physics plant compared with the laws of mechanics."""

import math

import numpy as np
import pytest

from diffdrive_mpc import make_plant
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.disturbances.disturbance_types import Slope
from diffdrive_mpc.sim.plants.chassis import Chassis
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.plants.twin_parameters import load_firmware, load_twin_parameters
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from studies.open_loop import OpenLoopDrive, drive_open_loop, random_commands

FRICTION = {name: load_surface(name).friction or 0.0 for name in ("slippery", "default", "grippy")}


def _twin(surface: str = "default") -> MujocoPlant:
    return MujocoPlant(FRICTION[surface], load_sensor_set("perfect"))


def _steady_drive(plant: MujocoPlant, v: float, omega: float, samples: int = 200) -> OpenLoopDrive:
    """Return the steady part of a drive with a constant command."""
    log = drive_open_loop(plant, np.tile([v, omega], (samples, 1)))
    half = samples // 2
    return OpenLoopDrive(*(getattr(log, name)[half:] for name in OpenLoopDrive.__dataclass_fields__))


@pytest.fixture(scope="module")
def steady() -> dict[str, OpenLoopDrive]:
    """Steady part of a gentle curve, by surface."""
    return {surface: _steady_drive(_twin(surface), 0.5, 0.5) for surface in FRICTION}


def test_resting_robot_does_not_move() -> None:
    plant = _twin()
    log = drive_open_loop(plant, np.zeros((250, 2)), pose=[1.0, -2.0, 0.7])
    np.testing.assert_allclose(log.true_pose, np.tile([1.0, -2.0, 0.7], (250, 1)), atol=1e-4)
    np.testing.assert_allclose(log.wheel_speeds, 0.0, atol=1e-6)
    assert (plant.chassis.wheel_loads > 0.0).all()


@pytest.mark.parametrize("v", [0.3, 1.0, -0.4])
def test_straight_speed_is_the_command(v: float) -> None:
    log = _steady_drive(_twin(), v, 0.0)
    encoders = log.wheel_twist[:, 0].mean()
    # The set-point is a whole number of pulses per second; its rounding error is at most half a pulse.
    half_pulse = np.pi * load_robot().wheel_radius / load_robot().encoder_pulses
    assert encoders == pytest.approx(load_firmware().gain_v * v, abs=half_pulse + 1e-3)
    # Loaded tyres roll on a slightly smaller radius than the encoders' twist assumes.
    assert 0.98 < log.true_twist[:, 0].mean() / encoders < 1.0
    np.testing.assert_allclose(log.true_twist[:, 1:], 0.0, atol=5e-3)


def test_yaw_rate_is_below_that_of_the_wheels(steady: dict[str, OpenLoopDrive]) -> None:
    for log in steady.values():
        assert 0.7 < log.true_twist[:, 2].mean() / log.wheel_twist[:, 1].mean() < 0.95


def test_side_slip_points_outward_and_grows_as_grip_falls(steady: dict[str, OpenLoopDrive]) -> None:
    lateral = {surface: log.true_twist[:, 1].mean() for surface, log in steady.items()}
    assert lateral["slippery"] < lateral["default"] < lateral["grippy"] < 0


def test_left_and_right_mirror_each_other_except_for_the_motors() -> None:
    left, right = _steady_drive(_twin(), 0.5, 0.8), _steady_drive(_twin(), 0.5, -0.8)
    np.testing.assert_allclose(left.true_twist.mean(axis=0), right.true_twist.mean(axis=0) * [1, -1, -1], atol=0.01)


def test_weak_motors_limit_the_speed_and_follow_lower_commands_again() -> None:
    twin = load_twin_parameters()
    weak_twin = twin.model_copy(update={"motor": twin.motor.model_copy(update={"no_load_speed": 15.0})})
    plant = MujocoPlant(FRICTION["default"], load_sensor_set("perfect"), twin=weak_twin)
    reachable = 15.0 * load_robot().wheel_radius
    log = drive_open_loop(plant, np.vstack([np.tile([1.5, 0.0], (150, 1)), np.tile([0.5, 0.0], (100, 1))]))
    v = log.wheel_twist[:, 0]
    # Without rolling resistance the no-load speed is the asymptote: reached up to the solver's residual, not exceeded.
    assert v.max() == pytest.approx(reachable, rel=1e-6)
    assert v[-30:].mean() == pytest.approx(0.5 * load_firmware().gain_v, abs=2e-3)


def test_robot_without_motor_torque_only_loses_energy() -> None:
    """Friction dissipates energy; only energy stored in the soft tyres is returned briefly."""
    robot, twin = load_robot(), load_twin_parameters()
    chassis = Chassis(robot, twin, FRICTION["default"], robot.sample_time / twin.substeps)
    for _ in range(250):
        chassis.step(np.array([-0.4, 1.2, -0.4, 1.2]))
    start = chassis.energy
    energies = []
    for _ in range(1000):
        chassis.step(np.zeros(4))
        energies.append(chassis.energy)
    deflection = 2e-3
    rocking_energy = robot.mass * 9.81 * deflection
    assert start > 10 * rocking_energy
    assert np.max(np.array(energies) - np.minimum.accumulate(energies)) < rocking_energy
    assert abs(chassis.twist[2]) < 1e-2


def test_robot_without_motor_torque_rolls_straight_on() -> None:
    robot, twin = load_robot(), load_twin_parameters()
    step = robot.sample_time / twin.substeps
    chassis = Chassis(robot, twin, FRICTION["default"], step)
    chassis.reset([0.0, 0.0, 0.5])
    for _ in range(250):
        chassis.step(np.full(4, 0.3))
    start, speed = chassis.pose, chassis.twist[0]
    for _ in range(500):
        chassis.step(np.zeros(4))
    assert chassis.twist[0] == pytest.approx(speed, rel=0.01)
    travelled = chassis.pose - start
    np.testing.assert_allclose(travelled[:2], 500 * step * speed * np.array([np.cos(0.5), np.sin(0.5)]), rtol=0.01)
    assert abs(travelled[2]) < 1e-3


def test_push_accelerates_the_mass_and_the_rotating_parts() -> None:
    """By Newton's law, the force 4 torque / radius accelerates mass + (wheel and rotor inertia) / radius^2."""
    robot, twin = load_robot(), load_twin_parameters()
    step = robot.sample_time / twin.substeps
    chassis = Chassis(robot, twin, FRICTION["grippy"], step)
    speeds = []
    for _ in range(250):
        chassis.step(np.full(4, 0.3))
        speeds.append(chassis.twist[0])
    wheel = 0.4 * twin.chassis.wheel_mass * robot.wheel_radius**2 + twin.motor.rotor_inertia
    expected = 4 * 0.3 / robot.wheel_radius / (robot.mass + 4 * wheel / robot.wheel_radius**2)
    assert (speeds[-1] - speeds[50]) / (199 * step) == pytest.approx(expected, rel=0.02)


def test_zero_command_stops_the_robot_and_keeps_it_at_rest() -> None:
    plant = _twin()
    drive_open_loop(plant, np.tile([1.0, 1.0], (100, 1)))
    for _ in range(75):
        plant.advance([0.0, 0.0])
    stop_pose = plant.true_pose
    for _ in range(250):
        plant.advance([0.0, 0.0])
    np.testing.assert_allclose(plant.true_pose, stop_pose, atol=1e-4)
    assert plant.chassis.energy < 1e-9


def test_acceleration_stays_within_friction() -> None:
    """Pitching shifts load briefly, but averaged over 0.1 s the surface carries exactly the weight."""
    log = drive_open_loop(_twin("slippery"), np.tile([1.2, 0.0], (60, 1)))
    samples = 5
    speed_change = log.true_twist[samples:, 0] - log.true_twist[:-samples, 0]
    acceleration = speed_change / (samples * load_robot().sample_time)
    limit = FRICTION["slippery"] * 9.81
    assert 0.9 * limit < acceleration.max() < 1.03 * limit


def test_yaw_turns_past_pi_without_a_jump() -> None:
    log = drive_open_loop(_twin(), np.tile([0.0, 1.5], (250, 1)), pose=[0.0, 0.0, 3.0])
    assert log.true_pose[-1, 2] > 3.0 + 2 * np.pi
    assert np.abs(np.diff(log.true_pose[:, 2])).max() < 0.1


def test_pose_is_the_integral_of_the_twist() -> None:
    log = drive_open_loop(_twin(), random_commands(5, duration=6.0))
    v, lateral, omega = (0.5 * (log.true_twist[1:] + log.true_twist[:-1])).T
    theta = 0.5 * (log.true_pose[1:, 2] + log.true_pose[:-1, 2])
    dt = load_robot().sample_time
    x = np.cumsum((v * np.cos(theta) - lateral * np.sin(theta)) * dt)
    y = np.cumsum((v * np.sin(theta) + lateral * np.cos(theta)) * dt)
    np.testing.assert_allclose(log.true_pose[1:, 0], x, atol=0.01)
    np.testing.assert_allclose(log.true_pose[1:, 1], y, atol=0.01)
    np.testing.assert_allclose(log.true_pose[1:, 2], np.cumsum(omega * dt), atol=0.01)


def slope(x, y) -> float:
    return np.dot(x, y) / np.dot(x, x)


def test_shipped_slip_of_the_surfaces_matches_mujoco() -> None:
    commands = random_commands(301)
    logs = {surface: drive_open_loop(_twin(surface), commands) for surface in FRICTION}
    for surface, log in logs.items():
        v, lateral, yaw_rate = log.true_twist.T
        measured = {
            "yaw_gain": slope(logs["default"].true_twist[:, 2], yaw_rate),
            "wheel_yaw_gain": slope(log.wheel_twist[:, 1], yaw_rate),
            "longitudinal_gain": slope(log.wheel_twist[:, 0], v),
            "side_slip": max(0.0, -slope(v * yaw_rate, lateral)),
        }
        shipped = load_surface(surface).slip
        for name, value in measured.items():
            assert getattr(shipped, name) == pytest.approx(value, rel=0.02), (surface, name)


GRAVITY = 9.81
ROBOT, TWIN = load_robot(), load_twin_parameters()
STEP = ROBOT.sample_time / TWIN.substeps


def _step_braked(chassis: Chassis, seconds: float) -> None:
    """Step the physics for `seconds` [s] with braked wheels."""
    for _ in range(round(seconds / STEP)):
        chassis.step(-1.0 * chassis.wheel_speeds)


def _drag(surface: str, direction: float, heading: float = 0.5) -> float:
    """Return the friction coefficient of a robot with braked wheels that is dragged over the surface.

    `direction` is the angle [rad] of the drag from forward to the left.
    """
    properties = load_surface(surface)
    chassis = Chassis(ROBOT, TWIN, properties.friction or 0.0, STEP, sideways=properties.sideways)
    chassis.reset([0.0, 0.0, heading])
    # The force is little above friction, because a robot that is pulled suddenly tips over.
    expected = (properties.friction or 0.0) * math.hypot(math.cos(direction), properties.sideways * math.sin(direction))
    force = 1.15 * expected * ROBOT.mass * GRAVITY
    chassis.push(force * math.cos(direction), force * math.sin(direction), 0.0, 0.0)
    _step_braked(chassis, 0.3)
    start_speed = np.hypot(*chassis.twist[:2])
    _step_braked(chassis, 0.2)
    return float(force / ROBOT.mass - (np.hypot(*chassis.twist[:2]) - start_speed) / 0.2) / GRAVITY


@pytest.mark.parametrize("surface", ["default", "carpet", "deep_carpet", "ice"])
def test_dragging_force_is_the_friction_in_each_direction(surface: str) -> None:
    properties = load_surface(surface)
    along, across = _drag(surface, 0.0), _drag(surface, math.pi / 2)
    assert along == pytest.approx(properties.friction, rel=0.05)
    assert across == pytest.approx(properties.sideways_friction or properties.friction, rel=0.05)
    # The result is independent of the heading of the robot.
    assert _drag(surface, math.pi / 2, heading=2.0) == pytest.approx(across, rel=0.01)


@pytest.mark.parametrize("surface", ["default", "carpet", "deep_carpet"])
def test_carpet_reduces_turning_as_coulomb_friction_predicts(surface: str) -> None:
    """Moment balance of four sliding wheels with elliptic friction: the force is friction squared times slip."""
    ratio = load_surface(surface).sideways * TWIN.chassis.wheel_base / ROBOT.track
    log = drive_open_loop(make_plant("mujoco", surface, "perfect"), np.tile([0.0, 1.0], (150, 1)))
    gain = log.true_twist[75:, 2].mean() / log.wheel_twist[75:, 1].mean()
    assert gain == pytest.approx(1 / (1 + ratio**2), abs=0.01 if surface == "default" else 0.015)


@pytest.mark.parametrize(("friction", "is_held"), [(0.25, True), (0.1, False)])
def test_robot_across_a_slope_of_ten_degrees_stays_or_slides_by_friction(friction: float, is_held: bool) -> None:
    """The tangent of the angle is 0.176: with less friction the acceleration is g (sin - friction cos) downhill."""
    angle = math.radians(10.0)
    chassis = Chassis(ROBOT, TWIN, friction, STEP, slope=Slope(angle=angle, downhill=math.pi / 2))
    _step_braked(chassis, 0.5)
    start_speed = chassis.twist[1]
    _step_braked(chassis, 0.5)
    acceleration = (chassis.twist[1] - start_speed) / 0.5
    if is_held:
        # Soft contacts creep; they do not speed up.
        assert abs(acceleration) < 0.01
        assert 0 <= chassis.pose[1] < 0.2
    else:
        expected = GRAVITY * (math.sin(angle) - friction * math.cos(angle))
        assert acceleration == pytest.approx(expected, rel=0.05)


def test_patch_on_a_carpet_preserves_the_ratio_of_the_directions() -> None:
    plant = make_plant("mujoco", "carpet")
    plant.chassis.set_friction(np.full(4, 0.2))
    assert _coefficients(plant) == pytest.approx((0.3, 0.2))


def _coefficients(plant: MujocoPlant) -> tuple[float, float]:
    across, along = plant.chassis._model.pair_friction[0, :2]
    return float(across), float(along)
