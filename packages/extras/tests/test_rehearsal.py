"""Rehearsal: learning from laps by their errors and by the slip of the surface."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ideal_robot import IdealRobot, drive
from scipy.integrate import cumulative_trapezoid

from commands import invoke
from diffdrive_mpc import Controller, Measurement, load_config, load_model, load_trajectory, make_plant
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc.models.slip_laws import polynomial_twist
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.moved import starting_at
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc_extras.rehearsal.config import rehearsal_of
from diffdrive_mpc_extras.rehearsal.drivable import nearest_drivable
from diffdrive_mpc_extras.rehearsal.laps import drive_laps
from diffdrive_mpc_extras.rehearsal.rehearsal import corrected

DT = 0.0202
BEND = time_segments(
    [Segment(v=0.5, omega=0.0, duration=1.5), Segment(v=0.5, omega=0.6, duration=2.0)],
    TrajectoryLimits.of_robot(),
    name="bend",
)


class DriftingRobot(IdealRobot):
    """Robot with a known error: it drifts to the left and back by up to `drift` [m/s] at equal times of each lap."""

    drift = 0.02

    def moved(self, theta, before, after):
        sideways = self.drift * np.sin(2 * np.pi * self.time / 3.0) * (self.time > 0.5)
        return super().moved(theta, before, after) + self.model.dt * sideways * np.array(
            [-np.sin(theta), np.cos(theta), 0.0]
        )


def controller(**settings):
    values = {"rehearsal.enabled": True, **{f"rehearsal.{key}": value for key, value in settings.items()}}
    return Controller(replace_values(load_config("ssm"), values))


def lap(mpc, *, seed=0, noise=0.0, slip=None, reference=BEND, robot=DriftingRobot, seconds=None):
    """Drive one lap; return the true position error (n, 2) [m] relative to the original reference, and the results."""
    plant = robot(load_model("ssm").discretise(DT), reference.sample([0.0]).pose[0], slip=slip, noise=noise, seed=seed)
    results, poses, times = drive(mpc, plant, reference, reference.duration + DT if seconds is None else seconds)
    return (poses - reference.sample(times).pose)[:, :2], results


def rms(error):
    return np.sqrt(np.mean(np.sum(error**2, axis=1)))


def test_repeating_error_is_removed():
    learning = controller()
    errors = [rms(lap(learning)[0]) for _ in range(5)]
    assert errors[0] > 0.003
    assert errors[-1] < 0.35 * errors[0]


def test_repeating_error_is_removed_under_noise():
    learning, reference = controller(), Controller(load_config("ssm"))
    learned_errors = np.array([lap(learning, seed=k, noise=1.0)[0] for k in range(6)])
    plain_errors = np.array([lap(reference, seed=k, noise=1.0)[0] for k in range(6)])
    varying = np.sqrt(np.mean([rms(error - plain_errors.mean(axis=0)) ** 2 for error in plain_errors]) * 6 / 5)
    # At least half of the repeating error is removed.
    total = np.mean([rms(error) for error in plain_errors])
    assert rms(learned_errors[-1]) < 0.5 * (total + varying)


def test_correction_stays_within_its_bounds_and_starts_at_zero():
    learning = controller(max_correction=0.002, max_correction_rate=0.01, max_heading_correction=0.004)
    for _ in range(4):
        lap(learning)
    learned_values = learning.feature("rehearsal").learned
    assert np.hypot(*learned_values.correction.T[:2]).max() <= 0.002
    assert np.hypot(*np.gradient(learned_values.correction[:, :2], learned_values.time, axis=0).T).max() <= 0.01 * (
        1 + 1e-9
    )
    assert np.abs(learned_values.correction[:, 2]).max() <= 0.004
    assert np.abs(learned_values.correction).max() > 0.001
    assert not learned_values.correction[0, :2].any()


class MirroredDriftRobot(DriftingRobot):
    drift = -0.04


@pytest.mark.parametrize(
    ("laps", "change", "message"),
    [(2, {"slip": Slip(yaw_gain=0.7)}, "surface changed"), (3, {"robot": MirroredDriftRobot}, "discarded")],
    ids=["changed surface", "larger error"],
)
def test_outdated_correction_is_discarded(laps, change, message):
    learning = controller()
    for _ in range(laps):
        lap(learning)
    assert learning.feature("rehearsal").learned.correction.any()
    lap(learning, **change)
    _, results = lap(learning)
    assert message in results[0].message
    assert not learning.feature("rehearsal").learned.correction.any()


def test_incomplete_lap_is_not_used_for_learning():
    learning = controller()
    for _ in range(2):
        lap(learning)
    lap(learning, seconds=1.0)
    original = learning.feature("rehearsal").learned.correction.copy()
    _, results = lap(learning)
    assert "it is incomplete" in results[0].message
    assert np.array_equal(learning.feature("rehearsal").learned.correction, original)


def test_lap_without_poses_is_not_used_for_learning():
    learning = controller()
    learning.start(BEND, 0.0)
    for k in range(5):
        learning.step(k * DT, Measurement())
    learning.start(BEND, 0.0)
    assert learning.feature("rehearsal").learned.laps == 0
    assert "at 0.00 s the mode was STOPPED" in learning.step(0.0, Measurement()).message


def test_moved_reference_counts_as_the_same_reference():
    learning = controller()
    for pose in ((0.0, 0.0, 0.0), (2.0, -1.0, 1.0), (5.0, 3.0, -2.0)):
        lap(learning, reference=starting_at(BEND, pose))
    learning.start(starting_at(BEND, (0.0, 0.0, 3.0)), 0.0)
    assert learning.feature("rehearsal").learned.laps == 3
    learning.start(load_trajectory("circle"), 0.0)
    assert learning.feature("rehearsal").learned.laps == 0
    assert not learning.feature("rehearsal").learned.correction.any()


def test_invalid_poses_are_not_used_for_learning():
    def corrupt(k, measurement):
        error = np.array([3.0, -2.0, 0.0]) if k % 40 == 20 else np.array([np.nan] * 3) if k % 40 == 30 else np.zeros(3)
        return replace(measurement, pose=replace(measurement.pose, value=measurement.pose.value + error))

    learning, clean = controller(), controller()
    for mpc, change in ((learning, corrupt), (clean, None)):
        for _ in range(2):
            drive(
                mpc, IdealRobot(load_model("ssm").discretise(DT), np.zeros(3)), BEND, BEND.duration + DT, change=change
            )
        mpc.start(BEND, 0.0)
    assert learning.feature("rehearsal").learned.laps == 2
    learned_values, undisturbed = (mpc.feature("rehearsal").learned.correction for mpc in (learning, clean))
    assert np.abs(learned_values - undisturbed)[:, :2].max() < 0.003


def test_twist_of_a_corrected_reference_matches_its_poses():
    time = np.linspace(0.0, BEND.duration, 200)
    correction = 0.01 * np.column_stack([np.sin(time), 1 - np.cos(time), np.zeros_like(time)])
    shifted = corrected(BEND, time, correction)
    original = BEND.sample(time)
    offset = shifted.sample(time).pose - original.pose
    along = offset[:, 0] * np.cos(original.pose[:, 2]) + offset[:, 1] * np.sin(original.pose[:, 2])
    assert np.allclose(along, correction[:, 0], atol=1e-12)
    assert np.allclose(np.hypot(offset[:, 0], offset[:, 1]), np.hypot(*correction.T[:2]), atol=1e-12)
    fine = np.linspace(0.5, BEND.duration - 0.5, 5000)
    sample = shifted.sample(fine)
    rate = np.gradient(sample.pose, fine, axis=0)
    v = rate[:, 0] * np.cos(sample.pose[:, 2]) + rate[:, 1] * np.sin(sample.pose[:, 2])
    assert np.allclose(sample.twist, np.column_stack([v, rate[:, 2]]), atol=2e-3)


CURVED = {"crab": 0.03, "veer": 0.02, "forward_coupling": 0.03, "yaw_coupling": 0.1}
SETTINGS = {"rehearsal.enabled": True, "rehearsal.by": "floor"} | {
    f"estimator.{name}_uncertainty": value for name, value in CURVED.items()
}
CONFIG = load_config("ssm", SETTINGS | {"estimator.side_slip": 0.0, "estimator.load_shift": 0.0})
INVERSE_GAIN = np.linalg.inv(load_model("ssm").dc_gain)
SURFACES = ("p4_asphalt", "p4_concrete", "p4_grass")
CORNER = time_segments(
    [Segment(v=0.5, omega=0.0, duration=1.5), Segment(v=0.0, omega=1.0, duration=1.5)]
    + [Segment(v=0.5, omega=0.0, duration=1.0)],
    TrajectoryLimits.of_robot(),
    name="corner",
)


def coefficients(surface):
    """Return the coefficients of Table 2 with a12 = 0, because a12 is used by the slip law of the controller only."""
    values = np.array(load_surface(surface).slip.polynomial.coefficients)
    values[1] = 0.0
    return values


def plan_motion(surface, reference=CORNER, config=CONFIG):
    return nearest_drivable(reference, Slip.of_polynomial(coefficients(surface)), config, INVERSE_GAIN)


def integrate_poses(surface, times, wheels, start):
    """Integrate poses (n, 3) of a body on a surface by the paper's slip law, with its twist on a fine grid."""
    pieces = 20
    fine = np.linspace(0.0, times[-1], pieces * (len(times) - 1) + 1)
    inputs = np.column_stack([np.interp(fine, times, wheels[:, i]) for i in (0, 1)])
    v, lateral, omega = polynomial_twist(coefficients(surface), inputs).T
    theta = start[2] + cumulative_trapezoid(omega, fine, initial=0.0)
    c, s = np.cos(theta), np.sin(theta)
    x, y = (cumulative_trapezoid(rate, fine, initial=0.0) for rate in (c * v - s * lateral, s * v + c * lateral))
    return np.column_stack([start[0] + x, start[1] + y, theta])[::pieces]


@pytest.mark.parametrize("surface", SURFACES)
def test_planned_motion_equals_the_integrated_motion(surface):
    motion = plan_motion(surface)
    integrated = integrate_poses(surface, motion.times, motion.wheels, motion.reference.pose[0])
    # The plan uses the mean twist of each interval.
    assert np.abs(integrated - motion.pose).max() < 5e-4
    assert motion.distance.max() > 0.003


@pytest.mark.parametrize("surface", SURFACES)
def test_planned_motion_satisfies_the_limits(surface):
    motion, limits = plan_motion(surface), CONFIG.limits
    commands = motion.wheels @ INVERSE_GAIN.T
    rates = np.diff(commands, axis=0) / motion.times[1]
    assert (np.abs(commands) <= np.array([limits.v, limits.omega]) + 1e-6).all()
    assert (np.abs(rates) <= np.array([limits.v_slew, limits.omega_slew]) + 1e-5).all()
    rim = np.abs(motion.wheels[:, 0]) + 0.5 * CONFIG.wheels.track * np.abs(motion.wheels[:, 1])
    assert rim.max() <= limits.wheel_speed + 1e-6


def test_limits_of_unused_directions_have_no_effect():
    sides = {"v.reverse": 0.1, "omega.right": 0.8}
    plans = [
        plan_motion("p4_asphalt", config=load_config(CONFIG, {f"limits.{k}": v for k, v in changed.items()}))
        for changed in ({}, sides)
    ]
    np.testing.assert_allclose(plans[1].pose, plans[0].pose, atol=5e-4)


def test_planned_motion_is_a_local_minimum():
    """Small feasible changes of the wheel twist do not lower the integrated cost."""
    surface, weights, rng = "p4_asphalt", rehearsal_of(CONFIG).drivable, np.random.default_rng(5)
    motion = plan_motion(surface)
    step, sample = motion.times[1], motion.reference
    # Wheel twist that gives the reference's twist without lateral slip, by Newton's method on the paper's slip law.
    twist = np.array(sample.twist)
    for _ in range(30):
        twist += sample.twist - polynomial_twist(coefficients(surface), twist)[:, [0, 2]]
    target_heading = sample.pose[:, 2] - np.arctan(coefficients(surface)[3] / (1 + coefficients(surface)[0]))

    def cost(wheels):
        pose = integrate_poses(surface, motion.times, wheels, sample.pose[0])
        position, heading = np.sum((pose - sample.pose)[1:, :2] ** 2, axis=1), (pose[:, 2] - target_heading)[1:] ** 2
        deviation = np.diff(wheels - twist, axis=0) / step
        rates = np.sum((deviation * [weights.v_rate, weights.omega_rate]) ** 2)
        ends = weights.end * position[-1] + weights.end_heading**2 * heading[-1]
        return step * (position.sum() + weights.heading**2 * heading.sum() + rates) + ends

    min_cost = cost(motion.wheels)
    assert cost(twist) > 3 * min_cost
    for _ in range(8):
        centre, width = rng.uniform(0.5, motion.times[-1] - 0.5), rng.uniform(0.1, 0.3)
        bump = np.exp(-(((motion.times - centre) / width) ** 2))
        bump[[0, -1]] = 0.0
        change = 0.01 * bump[:, None] * rng.normal(size=2)
        assert min(cost(motion.wheels + change), cost(motion.wheels - change)) > min_cost * (1 - 1e-3)


@settings(max_examples=12, deadline=None)
@given(
    v=st.floats(0.2, 0.6),
    omega=st.floats(-0.8, 0.8),
    turn=st.floats(-1.2, 1.2).filter(lambda turn: abs(turn) > 0.1),
    gains=st.tuples(st.floats(0.9, 1.1), st.floats(0.7, 1.2)),
)
def test_planned_motion_without_lateral_slip_is_the_reference(v, omega, turn, gains):
    segments = [Segment(v=v, omega=omega, duration=1.0), Segment(v=0.0, omega=turn, duration=0.8)]
    reference = time_segments(segments, TrajectoryLimits.of_robot(), name="any")
    slip = Slip(longitudinal_gain=gains[0], yaw_gain=gains[1])
    motion = nearest_drivable(reference, slip, CONFIG, INVERSE_GAIN)
    # The mean twist differs in intervals in which the reference changes its acceleration.
    assert motion.distance.max() < 5e-4


def test_planned_motion_satisfies_the_minimum_turn_radius():
    radius = 1.0
    wide = time_segments(
        [Segment(v=0.5, omega=0.0, duration=1.0), Segment(v=0.5, omega=0.4, duration=2.0)],
        TrajectoryLimits.of_robot(),
        name="wide",
    )
    config = load_config("ssm", SETTINGS | {"limits.min_turn_radius": radius})
    motion = plan_motion("p4_grass", wide, config)
    v, _, omega = polynomial_twist(coefficients("p4_grass"), motion.wheels[1:-1]).T
    assert (radius * np.abs(omega) <= v + 1e-6).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rehearsal.drivable.iterations": 1}, "the solver ended with maximum iterations exceeded"),
        ({"rehearsal.drivable.max_shift": 0.002}, "mm maximum distance"),
        ({"rehearsal.drivable.min_shift": 0.09}, "mm maximum distance"),
    ],
)
def test_reference_is_unchanged_if_there_is_no_lap_to_track(settings, message):
    controller = Controller(load_config("ssm", SETTINGS | settings))
    surface_lap(controller, "p4_concrete", CORNER)
    rehearsal = controller.feature("rehearsal").learned
    assert rehearsal.start(CORNER, 0.0) is CORNER
    assert message in rehearsal.message
    assert "tracked unchanged" in rehearsal.message
    assert not rehearsal.correction.any()


def surface_lap(controller, surface, reference, seed=0):
    """Drive a lap; return the RMS position error relative to the reference [m], the messages and the true poses."""
    run = simulate(controller, make_plant("model:ssm", surface, seed=seed), reference)
    return run.metrics.position_rmse_m, run.messages, run.true_pose


@pytest.mark.long
def test_error_on_the_square_is_below_ten_millimetres_after_three_laps():
    """Use the surface with the largest distance between turning point and centre; the second drive is identical."""
    square, laps = load_trajectory("square"), []
    # Repeat the drive up to the first lap that uses the planned motion.
    for controller, count in ((Controller(CONFIG), 4), (Controller(CONFIG), 2)):
        laps.append([surface_lap(controller, "p4_concrete", square, seed) for seed in range(count)])
    errors = [error for error, _, _ in laps[0]]
    assert errors[0] > 0.020
    assert errors[3] < 0.010
    assert any("slip learned from 3 laps" in message for message in laps[0][3][1])
    assert all(np.array_equal(first[2], second[2]) for first, second in zip(*laps, strict=False))


def test_first_lap_equals_a_lap_without_rehearsal():
    plain = Controller(load_config("ssm", SETTINGS | {"rehearsal.enabled": False}))
    learning = Controller(load_config("ssm", SETTINGS))
    assert np.array_equal(surface_lap(plain, "p4_grass", CORNER)[2], surface_lap(learning, "p4_grass", CORNER)[2])


def first_slip(controller):
    plant = make_plant("model:ssm", "p4_grass", seed=9)
    return controller.step(plant.time, plant.measure()).estimate.slip


def test_estimate_starts_with_the_learned_slip_until_reset():
    controller = Controller(CONFIG)
    surface_lap(controller, "p4_concrete", CORNER)
    controller.start(CORNER, 0.0)
    learned = controller.feature("rehearsal").learned.slip
    assert first_slip(controller) == learned
    assert learned.yaw_gain * learned.omega_gain == pytest.approx(0.606, abs=0.05)
    assert learned.v_offset == 0.0
    controller.update(limits={"omega": 1.9})
    controller.step(0.1, make_plant("model:ssm", "p4_grass").measure())
    controller.start(CORNER, 0.0)
    assert first_slip(controller) == controller.feature("rehearsal").learned.slip
    assert controller.feature("rehearsal").learned.config.limits.omega == 1.9
    controller.reset()
    controller.start(CORNER, 0.0)
    assert first_slip(controller) == Slip()
    assert controller.feature("rehearsal").learned.laps == 0


def test_harmful_correction_is_discarded():
    """Learn with the turning point behind the centre, and drive with the turning point ahead of the centre."""
    controller = Controller(CONFIG)
    for _ in range(2):
        surface_lap(controller, "p4_concrete", CORNER)
    surface_lap(controller, "p4_concrete_left", CORNER)
    controller.start(CORNER, 0.0)
    assert "discarded" in controller.feature("rehearsal").learned.message
    assert controller.feature("rehearsal").learned.laps == 0
    assert controller.feature("rehearsal").learned.slip == Slip()


PLAIN = Case(plant="model:sm", trajectory="cane")
LEARNING = PLAIN.with_override("expert.rehearsal.enabled", value=True)


@pytest.fixture(scope="module")
def plain():
    return drive_laps(PLAIN, 2).runs


def test_laps_have_different_noise_and_are_reproducible(plain):
    first, second = drive_laps(LEARNING, 2).runs, drive_laps(LEARNING, 2).runs
    assert all(np.array_equal(a.true_pose, b.true_pose) for a, b in zip(first, second, strict=True))
    assert np.array_equal(first[0].true_pose, plain[0].true_pose)
    assert not np.array_equal(plain[0].measured_pose, plain[1].measured_pose)
    assert not np.array_equal(first[1].command, plain[1].command)


@pytest.mark.parametrize("response", [{"sensors.pose.delay": 0.1}, {"sensors.pose.heading": 0.3}])
def test_stated_delay_and_heading_of_the_pose_sensor_are_not_learned_as_an_error(response):
    case = replace(PLAIN, plant="model:ssm", trajectory="s", overrides=tuple(response.items()))
    runs = drive_laps(case.with_override("expert.rehearsal.enabled", value=True), 3).runs
    assert runs[2].metrics.position_rmse_m < 0.75 * runs[0].metrics.position_rmse_m


def test_command_writes_a_row_for_each_lap_figures_and_log(tmp_path):
    log = tmp_path / "run.mcap"
    arguments = ["rehearse", "--plant", "model:sm", "--trajectory", "cane", "--laps", "2", "--out", tmp_path / "out"]
    result = invoke(app, *arguments, "--log", log)
    assert "learned from 1 lap," in result.output
    assert "vary from lap to lap (lower bound)" in " ".join(result.output.split())
    assert (tmp_path / "out" / "figures" / "laps.png").exists()
    drive_log = read_drive_log(log, plans=True)
    assert drive_log.metadata["case"]["repeat"].startswith("diffdrive-mpc rehearse --laps 2 ")
    assert any(plan is not None for plan in drive_log.plans)
