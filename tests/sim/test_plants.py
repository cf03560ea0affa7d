"""Properties of all plants: determinism, clean errors, and exact agreement of the model plant with its model."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_parts import trace

from diffdrive_mpc import integrate_pose, load_model, make_plant
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.plants.identified_robot import UnexplainedMotion, intensity_features
from diffdrive_mpc.sim.plants.model_plant import ModelPlant
from diffdrive_mpc.sim.plants.surface import BodySlip, Polynomial, VirtualTrack, load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from studies.open_loop import OpenLoopDrive, drive_open_loop, random_commands

DT = load_robot().sample_time
PLANTS = ["mujoco", "model:ssm"]
PERFECT = load_sensor_set("perfect")


@pytest.mark.parametrize("name", PLANTS)
def test_equal_seeds_give_equal_runs_bit_for_bit(name: str) -> None:
    plant = make_plant(name, sensors="slam", seed=7)
    first = trace(plant, 150)
    assert first == trace(make_plant(name, sensors="slam", seed=7), 150)
    plant.reset([0.0, 0.0, 0.0])
    assert first == trace(plant, 150)


@pytest.mark.parametrize("name", PLANTS)
def test_plant_reports_its_time_and_the_clipped_sent_command(name: str) -> None:
    plant = make_plant(name)
    assert isinstance(plant.sample_time, float)
    plant.reset([1.0, 2.0, 3.0])
    np.testing.assert_allclose(plant.true_pose, [1.0, 2.0, 3.0])
    assert plant.time == 0.0
    assert plant.measure().sent is None
    plant.advance([0.2, -0.1])
    assert plant.time == DT
    assert plant.measure().sent == (0.2, -0.1)
    plant.advance([9.0, -9.0])
    limits = load_robot().limits
    assert plant.measure().sent == (limits.v, -limits.omega)


def _model_output(extra_dead_time: float, commands: np.ndarray) -> np.ndarray:
    model = load_model("ssm").with_extra_dead_time([extra_dead_time] * 2).discretise(DT)
    return model.simulate(commands)


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), extra_dead_time=st.floats(0.0, 0.1))
def test_model_plant_without_slip_equals_its_model(seed: int, extra_dead_time: float) -> None:
    commands = random_commands(seed, duration=2.0)
    slip = load_surface("ideal").slip
    log = drive_open_loop(ModelPlant(load_model("ssm"), slip, PERFECT, extra_dead_time=extra_dead_time), commands)
    expected = _model_output(extra_dead_time, commands)
    np.testing.assert_allclose(log.output, expected, atol=1e-12)
    np.testing.assert_allclose(log.wheel_twist, expected, atol=1e-12)
    mean = 0.5 * (expected[1:] + expected[:-1])
    pose = np.zeros(3)
    for k, (v, omega) in enumerate(mean):
        pose = integrate_pose(pose, v, omega, DT)
        np.testing.assert_allclose(log.true_pose[k + 1], pose, atol=1e-12)


def _drive_named(name: str, commands: np.ndarray, **options: float) -> OpenLoopDrive:
    return drive_open_loop(make_plant(name, surface="ideal", sensors="perfect", **options), commands)  # type: ignore[arg-type]


@pytest.mark.parametrize("model", ["sm", "mbm", "ssm"])
def test_dead_time_in_the_name_delays_the_outputs(model: str) -> None:
    commands = random_commands(8, duration=3.0)
    plain, delayed = _drive_named(f"model:{model}", commands), _drive_named(f"model:{model}+{2 * DT}", commands)
    np.testing.assert_allclose(delayed.output[2:], plain.output[:-2], atol=1e-12)
    np.testing.assert_allclose(delayed.output[:2], 0.0, atol=1e-12)
    assert np.abs(plain.output).max() > 0.3
    np.testing.assert_array_equal(
        _drive_named(f"model:{model}+0.013", commands).output,
        _drive_named(f"model:{model}", commands, extra_dead_time=0.013).output,
    )


def _drive_with_slip(**changes: float) -> OpenLoopDrive:
    slip = BodySlip(**{"yaw_gain": 1.0, "wheel_yaw_gain": 1.0, "longitudinal_gain": 1.0, "side_slip": 0.0} | changes)
    return drive_open_loop(ModelPlant(load_model("ssm"), slip, PERFECT), random_commands(6, duration=4.0))


def test_model_plant_applies_its_slip_to_the_twist_and_the_wheels() -> None:
    plain = _drive_with_slip()
    v, omega = plain.output.T
    slipped = _drive_with_slip(yaw_gain=0.9, wheel_yaw_gain=0.6, longitudinal_gain=0.95, side_slip=0.05)
    np.testing.assert_allclose(slipped.true_twist[:, 0], 0.95 * v)
    np.testing.assert_allclose(slipped.true_twist[:, 2], 0.9 * omega)
    np.testing.assert_allclose(slipped.true_twist[:, 1], -0.05 * 0.95 * v * 0.9 * omega)
    np.testing.assert_allclose(slipped.yaw_rate, 0.9 * omega, atol=1e-12)
    np.testing.assert_allclose(slipped.wheel_twist, np.column_stack([v, 0.9 / 0.6 * omega]), atol=1e-12)


def test_side_slip_moves_the_body_sideways() -> None:
    """On a steady circle, side slip turns the direction of travel outward by atan(side slip * omega)."""
    slip = BodySlip(yaw_gain=1.0, wheel_yaw_gain=1.0, longitudinal_gain=1.0, side_slip=0.1)
    log = drive_open_loop(ModelPlant(load_model("ssm"), slip, PERFECT), np.tile([0.5, 0.8], (300, 1)))
    step = np.diff(log.true_pose[150:], axis=0)
    heading = 0.5 * (log.true_pose[150:-1, 2] + log.true_pose[151:, 2])
    course = np.unwrap(np.arctan2(step[:, 1], step[:, 0]) - heading)
    omega = log.true_twist[150:-1, 2]
    np.testing.assert_allclose(np.remainder(course + np.pi, 2 * np.pi) - np.pi, -np.arctan(0.1 * omega), atol=1e-4)


def test_delivered_pose_between_ticks_is_on_the_path() -> None:
    """Poses at 10 Hz fall between ticks; on a steady circle they must also be on that circle."""
    exact_slam = PERFECT.model_copy(update={"pose": PERFECT.pose.model_copy(update={"period": 0.1, "latency": 0.06})})
    plant = ModelPlant(load_model("ssm"), load_surface("ideal").slip, exact_slam)
    truth, delivered = [], []
    for _ in range(300):
        measurement = plant.measure()
        truth.append([plant.time, *plant.true_pose])
        if measurement.pose is not None:
            delivered.append([measurement.pose.time, *np.asarray(measurement.pose.value)[:2]])
        plant.advance([0.4, 0.6])
    times, xy = np.array(truth)[:, 0], np.array(truth)[:, 1:3]
    poses = np.array([row for row in delivered if row[0] > 0])
    assert len(poses) > 50
    for column in (0, 1):
        # The difference of chord and arc over one sample: v omega dt^2 / 8 = 1.2e-5 m.
        np.testing.assert_allclose(poses[:, 1 + column], np.interp(poses[:, 0], times, xy[:, column]), atol=2e-5)


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("dt", [0.01, 0.05, 0.1])
def test_sample_time_of_constant_commands_has_no_effect(name: str, dt: float) -> None:
    plants = [make_plant(name, sensors="perfect", sample_time=sample_time) for sample_time in (None, dt)]
    for plant in plants:
        while plant.time < 2.0 - 1e-9:
            plant.advance([0.4, 0.5])
    base, resampled = plants
    # Steps of the physics differ by a few per cent, and the ends of the drives by less than a tick.
    expected = integrate_pose(base.true_pose, base.true_twist[0], base.true_twist[2], resampled.time - base.time)
    assert resampled.sample_time == dt
    np.testing.assert_allclose(resampled.true_pose, expected, atol=2e-3)


def test_model_plant_uses_the_limits_of_its_robot() -> None:
    fast = load_robot().limits.model_copy(update={"v": 3.0})
    plant = make_plant("model:sm", sensors="perfect", limits=fast)
    for _ in range(100):
        plant.advance([2.5, 0.0])
    assert plant.true_twist[0] == pytest.approx(2.5 * load_model("sm").dc_gain[0, 0], rel=0.01)


def test_body_of_the_model_plant_follows_the_slip_laws_and_the_unexplained_motion() -> None:
    rng = np.random.default_rng(5)
    terms = dict(zip(Polynomial.model_fields, rng.uniform(-0.1, 0.1, 9).tolist(), strict=True))
    laws = {"polynomial": Polynomial(**terms), "virtual_track": VirtualTrack(p0=0.4, p1=0.1)}
    slip = load_surface("default").slip.model_copy(update=laws)
    variance, yaw_slip = rng.uniform(0.0, 1e-4, (3, 6)), (0.2, -0.4)
    motion = UnexplainedMotion(rng.normal(size=(7, 3)), variance, np.full(6, 0.3), 0.05, yaw_slip)
    ideal = ModelPlant(load_model("ssm"), load_surface("ideal").slip, PERFECT)
    plants = [ModelPlant(load_model("ssm"), slip, PERFECT, disturbance=unexplained) for unexplained in (None, motion)]
    last_output = np.zeros(2)
    for tick, command in enumerate(random_commands(2, duration=1.0), start=1):
        for plant in (ideal, *plants):
            plant.advance(command)
        output = ideal.true_twist[[0, 2]]
        rate = (output - last_output) / DT
        features = np.minimum(intensity_features(output, rate), motion.largest)
        unexplained = motion.rows[tick % 7] * np.sqrt(motion.variance @ features)
        unexplained -= [0.05 * abs(output[1]) * rate[0], 0.0, output[1] * (0.4 * features[1] - 0.2)]
        np.testing.assert_allclose(plants[0].true_twist, slip.body(output), atol=1e-12)
        np.testing.assert_allclose(plants[1].true_twist, slip.body(output) + unexplained, atol=1e-9)
        last_output = output


def test_encoders_measure_the_unexplained_motion_of_the_wheels() -> None:
    variance, slip = np.outer([0.01, 0.0, 0.04], np.eye(6)[0]), load_surface("default").slip
    readings, twists = [], []
    for on_wheels in ((False, False), (True, True)):
        motion = UnexplainedMotion(np.ones((1, 3)), variance, np.ones(6), on_wheels=on_wheels)
        plant = ModelPlant(load_model("ssm"), slip, PERFECT, disturbance=motion)
        plant.advance([0.5, 0.5])
        readings.append(np.asarray(plant.measure().wheel_twist.value))
        twists.append(plant.true_twist)
    np.testing.assert_array_equal(twists[0], twists[1])
    np.testing.assert_allclose(readings[1] - readings[0], [0.1, 0.2 / slip.wheel_yaw_gain], atol=1e-12)
