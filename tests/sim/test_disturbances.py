"""Disturbances: scenario files, commands, sensor readings, and forces in the physics."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_parts import trace

from diffdrive_mpc import ConfigError, RobotLostError, make_plant
from diffdrive_mpc.models.checked_yaml import check
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.disturbances.disturbance_types import Payload
from diffdrive_mpc.sim.disturbances.scenario import SCENARIOS, Scenario, load_scenario
from diffdrive_mpc.sim.plants.chassis import WHEELS, Chassis
from diffdrive_mpc.sim.plants.disturbed_plant import DisturbedPhysics, DisturbedPlant
from diffdrive_mpc.sim.plants.drivetrain import VelocityLoops
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.plants.twin_parameters import load_twin_parameters
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from refusals import one_line_error
from studies.open_loop import drive_open_loop

PLANTS = ["mujoco", "model:ssm"]
DT = load_robot().sample_time
DISTURBANCES = sorted({*SCENARIOS.names} - {"none"})


def _scenario(**parts: Any) -> Scenario:
    return check(Scenario, {"description": "test", **parts}, "test")


def _disturbed_plant(name: str, **parts: Any) -> DisturbedPlant:
    return DisturbedPlant(make_plant(name, sensors="perfect"), _scenario(**parts), load_robot())


@pytest.mark.parametrize("name", ["patches", "push", "blocked", "sensor_dropouts"])
def test_equal_seeds_give_equal_disturbed_runs_bit_for_bit(name: str) -> None:
    plant = make_plant("mujoco", seed=5, scenario=name)
    first = trace(plant, 300)
    assert plant.disturbance is not None
    assert first == trace(make_plant("mujoco", seed=5, scenario=name), 300)
    plant.reset([0.0, 0.0, 0.0])
    assert trace(plant, 300) == first


def test_future_disturbance_changes_no_motion(tmp_path: Path) -> None:
    path = tmp_path / "later.yaml"
    path.write_text(
        "description: all of it after the drive\n"
        "patches: [{start: 90, friction: 0.3}]\n"
        "weak_motors: [{wheel: front_left, factor: 0.1, start: 90}]\n"
        "slipping_wheels: [{wheel: front_left, friction: 0.1, start: 90}]\n"
        "battery: {start: [90, 95], duration: 1, after: 0.5}\n"
        "drop_outs: [{sensor: pose, start: 90, duration: 1}]\n"
        "false_commands: [{v: 1, omega: 1, start: 90, duration: 1}]\n"
        "pushes: [{force: 50, height: 0, start: 90, duration: 1}]\n"
        "blockades: [{start: 90, duration: 1, height: 0, "
        "stiffness: 10, damping: 1, yaw_stiffness: 1, yaw_damping: 1}]\n"
    )
    plant = make_plant("mujoco", seed=2, scenario=path)
    assert trace(plant, 150) == trace(make_plant("mujoco", seed=2), 150)
    assert plant.disturbance is None


@pytest.mark.parametrize("name", PLANTS)
def test_start_offset_is_relative_to_the_start_of_the_reference(name: str) -> None:
    plant = _disturbed_plant(name, start_offset={"along": 0.3, "across": 0.2, "heading": -0.4})
    plant.reset([1.0, 2.0, np.pi / 2])
    np.testing.assert_allclose(plant.true_pose, [1.0 - 0.2, 2.0 + 0.3, np.pi / 2 - 0.4], atol=1e-12)
    np.testing.assert_allclose(np.asarray(plant.measure().pose.value), plant.true_pose, atol=1e-12)  # type: ignore[union-attr]
    assert plant.disturbance == (0.0, 0.0)


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize(
    ("sensor", "fields"), [("pose", {"pose"}), ("wheels", {"wheel_twist", "wheel_speeds"}), ("gyro", {"yaw_rate"})]
)
def test_drop_out_removes_only_the_readings_of_its_sensor(name: str, sensor: str, fields: set[str]) -> None:
    plant = _disturbed_plant(name, drop_outs=[{"sensor": sensor, "start": 0.2, "duration": 0.3}])
    for _ in range(40):
        time, measurement = plant.time, plant.measure()
        for field in ("pose", "wheel_twist", "wheel_speeds", "yaw_rate"):
            is_missing = field in fields and 0.2 <= time < 0.5
            assert (getattr(measurement, field) is None) == is_missing, (field, time)
        plant.advance([0.3, 0.2])


@pytest.mark.parametrize("name", PLANTS)
def test_false_command_moves_the_robot_and_is_not_reported(name: str) -> None:
    command = {"v": 0.0, "omega": 1.0, "start": 10 * DT - 1e-6, "duration": 0.5}
    plant, undisturbed = _disturbed_plant(name, false_commands=[command]), make_plant(name, sensors="perfect")
    for k in range(60):
        is_active = 10 <= k < 10 + int(np.ceil(0.5 / DT))
        plant.advance([0.4, 0.0])
        undisturbed.advance([0.0, 1.0] if is_active else [0.4, 0.0])
        np.testing.assert_array_equal(plant.true_pose, undisturbed.true_pose)
        assert plant.measure().sent == (0.4, 0.0)
    assert plant.true_pose[2] > 0.3


@pytest.mark.parametrize("name", DISTURBANCES)
def test_velocity_models_refuse_scenarios_that_need_mass_or_wheels(name: str) -> None:
    needs = load_scenario(name).draw(0).physical
    if not needs:
        assert isinstance(make_plant("model:ssm", scenario=name), DisturbedPlant)
        return
    line = f"scenario '{name}' needs a plant with mass, wheels and motors ({', '.join(needs)})"
    with one_line_error(ConfigError, line, "use 'mujoco'"):
        make_plant("model:ssm", scenario=name)


G = 9.81
ROBOT, TWIN = load_robot(), load_twin_parameters()
STEP = ROBOT.sample_time / TWIN.substeps
DEFAULT_FRICTION = load_surface("default").friction or 0.0
SLIPPERY = load_surface("slippery").friction or 0.0
ICE = 1e-5
LEFT, RIGHT = ("front_left", "rear_left"), ("front_right", "rear_right")


def _plant(friction: float = DEFAULT_FRICTION, **parts: Any) -> MujocoPlant:
    return MujocoPlant(friction, load_sensor_set("perfect"), scenario=_scenario(**parts))


def _drive(plant: MujocoPlant, v: float, omega: float, seconds: float) -> None:
    for _ in range(round(seconds / ROBOT.sample_time)):
        plant.advance([v, omega])


@pytest.mark.parametrize("direction", [0.7, 1.5708])
def test_push_on_ice_gives_force_times_time(direction: float) -> None:
    """Start and end of the push fall between physics steps: the momentum matches its exact duration."""
    push = {"force": 20.0, "direction": direction, "height": 0.09, "start": 0.1013, "duration": 0.2507}
    plant = _plant(ICE, pushes=[push])
    plant.reset([1.0, 2.0, 0.5])
    _drive(plant, 0.0, 0.0, 0.5)
    v, lateral, omega = plant.true_twist
    course = 0.5 + direction
    displacement = plant.true_pose[:2] - [1.0, 2.0]
    assert ROBOT.mass * np.hypot(v, lateral) == pytest.approx(20.0 * 0.2507, rel=0.02)
    assert np.arctan2(displacement[1], displacement[0]) == pytest.approx(course, abs=0.02)
    assert abs(omega) < 0.02


def test_yaw_push_on_ice_gives_torque_times_time() -> None:
    plant = _plant(ICE, pushes=[{"yaw_torque": 0.5, "height": 0.09, "start": 0.1, "duration": 0.3}])
    _drive(plant, 0.0, 0.0, 0.5)
    omega = plant.true_twist[2]
    # Angular momentum I omega about the vertical, from the kinetic energy I omega^2 / 2 of the pure rotation.
    assert 2 * plant.chassis.energy / omega == pytest.approx(0.5 * 0.3, rel=0.02)


def test_friction_holds_a_robot_against_a_weaker_push() -> None:
    limit = DEFAULT_FRICTION * ROBOT.mass * G
    distances = []
    for share in (0.8, 1.3):
        push = {"force": share * limit, "direction": 1.5708, "height": 0.05, "start": 0.1, "duration": 0.3}
        plant = _plant(pushes=[push])
        _drive(plant, 0.0, 0.0, 1.0)
        distances.append(abs(plant.true_pose[1]))
    # Coulomb friction: (share - 1) mu g of acceleration during the push, mu g of deceleration after it.
    speed = 0.3 * DEFAULT_FRICTION * G * 0.3
    assert distances[1] == pytest.approx(0.5 * speed * 0.3 + speed**2 / (2 * DEFAULT_FRICTION * G), rel=0.25)
    assert distances[0] < 0.2 * distances[1]


def test_payload_adds_its_weight_at_its_position() -> None:
    x, y, mass = 0.03, -0.05, 2.5
    load = Payload(mass=mass, x=x, y=y, z=0.1, radius=0.05)
    with_load, without_load = (Chassis(ROBOT, TWIN, DEFAULT_FRICTION, STEP, payload) for payload in (load, None))
    for chassis in (with_load, without_load):
        for _ in range(round(1.0 / STEP)):
            chassis.step(np.zeros(4))
    assert without_load.wheel_loads.sum() == pytest.approx(ROBOT.mass * G, rel=1e-3)
    assert with_load.wheel_loads.sum() == pytest.approx((ROBOT.mass + mass) * G, rel=1e-3)
    front, left = (
        sum(with_load.wheel_loads[i] for i, name in enumerate(WHEELS) if part in name) for part in ("front", "left")
    )
    # Moments about the rear axle and about the right wheels.
    half = 0.5 * (ROBOT.mass + mass) * G
    assert front == pytest.approx(half + mass * G * x / TWIN.chassis.wheel_base, rel=0.02)
    assert left == pytest.approx(half + mass * G * y / ROBOT.track, rel=0.02)


def test_robot_on_a_gentle_slope_rests_across_it_and_creeps_along_it() -> None:
    across, along = (_plant(slope={"angle": 0.1, "downhill": downhill}) for downhill in (np.pi / 2, 0.0))
    for plant in (across, along):
        _drive(plant, 0.0, 0.0, 2.0)
    # Tyres creep below the friction limit, like rubber.
    assert 0.0 <= across.true_twist[1] < 0.01
    # At zero set-point the driver shorts the motor, which brakes by back-EMF in proportion to the speed.
    pull = ROBOT.mass * G * np.sin(0.1)
    damping = 4 * TWIN.motor.stall_torque / TWIN.motor.no_load_speed / ROBOT.wheel_radius**2
    assert 0.0 < along.true_twist[0] < 1.2 * pull / damping
    assert along.true_pose[0] > 0.01


def test_dead_motors_do_not_drive_and_a_dead_side_turns_the_robot() -> None:
    def drive_with_dead_motors(wheels: tuple[str, ...]) -> MujocoPlant:
        plant = _plant(weak_motors=[{"wheel": wheel, "factor": 0.0, "start": 0.0} for wheel in wheels])
        _drive(plant, 0.4, 0.0, 1.0)
        return plant

    assert abs(drive_with_dead_motors(WHEELS).true_pose[0]) < 1e-3
    # The robot turns towards the side that is dragged.
    assert drive_with_dead_motors(LEFT).true_pose[2] > 0.03
    assert drive_with_dead_motors(RIGHT).true_pose[2] < -0.03


def _disturbances(**parts: Any) -> tuple[DisturbedPhysics, VelocityLoops]:
    chassis = Chassis(ROBOT, TWIN, DEFAULT_FRICTION, STEP)
    loops = VelocityLoops(TWIN.driver, TWIN.motor, 2 * np.pi / ROBOT.encoder_pulses, STEP)
    base, torque = TWIN.chassis.wheel_base, TWIN.motor.stall_torque
    return DisturbedPhysics(_scenario(**parts), chassis, loops, DEFAULT_FRICTION, base, torque), loops


def test_slipping_wheel_pushes_no_harder_than_its_friction() -> None:
    """Under full throttle the side with grip pulls ahead: the robot turns towards the slipping wheel."""
    slipping = [{"wheel": wheel, "friction": 0.02, "start": 0.0, "duration": 1.0} for wheel in LEFT]
    plant = _plant(slipping_wheels=slipping)
    _drive(plant, 0.8, 0.0, 0.6)
    assert plant.true_pose[2] > 0.05
    all_slip = [{"wheel": wheel, "friction": 0.02, "start": 0.0, "duration": 1.0} for wheel in WHEELS]
    plant = _plant(slipping_wheels=all_slip)
    _drive(plant, 0.8, 0.0, 0.9)
    moving = plant.time - 2 * TWIN.link.dead_time
    assert 0.7 * moving < plant.true_twist[0] / (0.02 * G) < plant.time
    assert plant.chassis.wheel_speeds.min() * ROBOT.wheel_radius > 0.7


def test_sag_lowers_the_stall_torque_in_proportion_and_load_lowers_the_voltage() -> None:
    disturbances, loops = _disturbances(battery={"start": 1.0, "duration": 2.0, "after": 0.5, "load_drop": 0.1})
    stall = TWIN.motor.stall_torque * np.array(TWIN.motor.spread)
    for time, voltage in ((0.0, 1.0), (1.0, 1.0), (2.0, 0.75), (3.0, 0.5), (9.0, 0.5)):
        disturbances.motors(np.zeros(4), time)
        disturbances.before_step(time, time + STEP)
        full = loops.torque(np.full(4, 1e3), np.zeros(4), np.zeros(4))
        np.testing.assert_allclose(full, voltage * stall)
    disturbances.motors(TWIN.motor.stall_torque * np.array([1.0, -1.0, 1.0, -1.0]), 9.0)
    disturbances.before_step(9.0, 9.0 + STEP)
    assert loops.supply == pytest.approx(0.5 - 0.1)


def test_robot_on_a_patch_slips_as_on_a_surface_with_this_friction() -> None:
    lateral = {}
    patch = {"start": 0.2, "friction": SLIPPERY}
    for name, plant in {"patch": _plant(patches=[patch]), "slippery": _plant(SLIPPERY), "default": _plant()}.items():
        lateral[name] = drive_open_loop(plant, np.tile([0.5, 0.5], (250, 1))).true_twist[150:, 1].mean()
    assert lateral["patch"] == pytest.approx(lateral["slippery"], rel=0.02)
    assert lateral["patch"] < 2 * lateral["default"] < 0


def test_patch_starts_and_ends_at_its_position() -> None:
    """Front wheels reach a patch half a wheel base before the centre; rear wheels leave it half a wheel base later."""
    half = TWIN.chassis.wheel_base / 2
    plant = _plant(patches=[{"start": 0.5, "length": 0.6, "friction": 0.5}, {"start": 50.0, "friction": 0.5}])
    log = drive_open_loop(plant, np.tile([0.5, 0.0], (200, 1)))
    ((enter, leave),) = plant.patch_spans
    assert np.isfinite(leave)
    assert np.interp([enter, leave], log.time, log.true_pose[:, 0]) == pytest.approx([0.5 - half, 1.1 + half], abs=2e-3)


def test_only_the_side_on_ice_slips() -> None:
    """A robot that accelerates hard with one side on ice turns towards the ice."""
    turns = {}
    for side in ("left", "right", "both"):
        plant = _plant(patches=[{"start": 0.0, "friction": 0.02, "side": side}])
        _drive(plant, 0.3, 0.0, 0.8)
        start = plant.true_pose
        assert start[0] > TWIN.chassis.wheel_base  # all wheels are on the ice
        _drive(plant, 1.2, 0.0, 0.5)
        turns[side] = plant.true_pose[2] - start[2]
    assert turns["left"] > 0.05
    assert turns["right"] < -0.05
    assert abs(turns["both"]) < 0.01


def test_blockade_holds_the_robot_and_releases_it() -> None:
    hold = {"height": 0.02, "stiffness": 5e3, "damping": 260.0, "yaw_stiffness": 500.0, "yaw_damping": 11.0}
    plant = _plant(blockades=[{"start": 1.0, "duration": 1.0, **hold}])
    log = drive_open_loop(plant, np.tile([0.5, 0.3], (200, 1)))
    is_held = (log.time > 1.0) & (log.time < 2.0)
    start = log.true_pose[np.flatnonzero(is_held)[0]]
    # All wheels skid and push with at most the friction against the spring.
    max_displacement = DEFAULT_FRICTION * ROBOT.mass * G / 5e3 + 0.5 * np.sqrt(ROBOT.mass / 5e3)
    assert np.hypot(*(log.true_pose[is_held] - start)[:, :2].T).max() < max_displacement
    assert log.wheel_twist[is_held, 0][10:].mean() > 0.3
    assert np.abs(log.true_twist[is_held, 0][10:]).mean() < 0.05
    free = log.true_twist[log.time > 2.5]
    assert free[:, 0].mean() == pytest.approx(0.5, rel=0.03)


def test_diverging_motion_raises_robot_lost_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    plant = _plant(pushes=[{"force": 1e200, "height": 0.09, "start": 0.1, "duration": 0.2}])
    plant.reset([1.0, 2.0, 0.5])
    with pytest.raises(RobotLostError, match=r"t = 0\.1\d s: the simulation diverged"):
        _drive(plant, 0.0, 0.0, 0.5)
    assert not list(tmp_path.iterdir())  # MuJoCo would leave a log file


@given(seed=st.integers(0, 10_000), low=st.floats(0.1, 5.0), width=st.floats(0.0, 5.0))
def test_random_values_are_in_their_ranges_and_choices(
    tmp_path_factory: pytest.TempPathFactory, seed: int, low: float, width: float
) -> None:
    path = tmp_path_factory.mktemp("scenario") / "mine.yaml"
    random_values = f"force: [{low}, {low + width}], yaw_torque: {{one_of: [[-2.0, -1.0], [1.0, 2.0]]}}"
    path.write_text(f"description: mine\npushes: [{{{random_values}, height: 0, start: 1, duration: 1}}]\n")
    file = load_scenario(path)
    (push,) = file.draw(seed).pushes
    assert low <= push.force <= low + width
    assert 1.0 <= abs(push.yaw_torque) <= 2.0
    assert file.draw(seed) == file.draw(seed)
