"""The oracle's estimator, and its filter against finite differences and the textbook filter."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from ideal_robot import IdealRobot, NoisyRobot
from scipy.stats import chi2

from diffdrive_mpc import Stamped, integrate_pose, load_model
from diffdrive_mpc.mpc.config.schema import Compensation, Estimator, PoseResponse, SensorResponses, WheelResponse
from diffdrive_mpc.mpc.estimate import SENSORS
from diffdrive_mpc.mpc.problem.slip import FLAT_SLIPS, Slip
from oracle.estimator import StateEstimator
from oracle.kalman import Belief, SlipFilter

DT = 0.0202
MODEL = load_model("ssm").with_extra_dead_time([0.01, 0.03]).discretise(DT)


class TextbookEstimator(Estimator):
    """Settings without thresholds on innovations and speeds."""

    surprise: ClassVar[float] = 1e9
    min_yaw_rate: ClassVar[float] = 1e-9
    min_speed: ClassVar[float] = 1e-9


SETTINGS = TextbookEstimator()
FILTER = SlipFilter(MODEL, SETTINGS, Compensation(), 1.1)
N = MODEL.order
SIZE = N + 16
ZERO_COVARIANCE = np.zeros((SIZE, SIZE))
STEP = 1e-6
NEUTRAL = np.concatenate([np.zeros(N), [0, 1, 1, 1, *[0] * 7], np.zeros(5)])
# Delays within one sample, because the prediction has kinks at whole samples.
SPREAD = np.concatenate([np.ones(N + 11), [0.0, 0.0], np.ones(3)])
DELAYS = np.concatenate([np.zeros(N + 11), [0.4 * DT, 0.7 * DT], np.zeros(3)])

means = st.lists(st.floats(-0.5, 0.5), min_size=SIZE, max_size=SIZE).map(
    lambda z: NEUTRAL + DELAYS + SPREAD * np.array(z)
)
commands = st.lists(st.floats(-1, 1), min_size=2, max_size=2).map(np.array)


def gradient(function, point):
    columns = [(function(point + STEP * e) - function(point - STEP * e)) / (2 * STEP) for e in np.eye(len(point))]
    return np.column_stack(columns) if np.ndim(columns[0]) else np.array(columns)


@given(means, st.lists(commands, min_size=4, max_size=4).map(np.array))
def test_predicted_covariance_follows_the_gradient_of_the_prediction(mean, active_commands):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(SIZE, SIZE))
    P = root @ root.T
    noise = FILTER.predict(Belief(mean, ZERO_COVARIANCE), active_commands).covariance
    acceleration = FILTER.acceleration(mean, active_commands)
    F = gradient(lambda z: FILTER.process(z, active_commands, acceleration), mean)
    predicted = FILTER.predict(Belief(mean, P), active_commands).covariance
    assert predicted - noise == pytest.approx(F @ P @ F.T, abs=1e-5)
    assert np.linalg.eigvalsh(noise).min() > -1e-15


def test_process_noise_acts_on_the_inputs():
    noise = FILTER.predict(Belief(NEUTRAL, ZERO_COVARIANCE), np.zeros((4, 2))).covariance
    settings, drive = Estimator(), MODEL.B0 + MODEL.B1
    expected = drive @ np.diag(np.square([settings.v_input_noise, settings.omega_input_noise])) @ drive.T
    assert noise[:N, :N] == pytest.approx(expected, rel=1e-9)


def test_gains_and_their_variances_stay_constant_at_rest():
    belief = Belief(NEUTRAL, np.diag(np.full(SIZE, 0.01)))
    predicted = SlipFilter(MODEL, Estimator(), Compensation(), 1.1).predict(belief, np.zeros((4, 2)))
    growth = np.diag(predicted.covariance - belief.covariance)[N : N + 11]
    assert (growth[[0, 10]] > 0).all()
    assert growth[1:10] == pytest.approx(0, abs=1e-15)


@given(means, st.floats(0, 0.9 * DT))
def test_pose_correction_equals_the_textbook_filter(mean, ahead):
    """Mean and covariance equal those of an extended Kalman filter with gradients from finite differences."""
    assume(abs(FILTER.twist(mean)[1]) > 1e-6)
    rng = np.random.default_rng(1)
    root = 0.1 * rng.normal(size=(SIZE, SIZE))
    P, R = root @ root.T, np.diag([1e-4, 2e-4, 3e-4])
    innovation = np.array([0.01, -0.02, 0.03])
    pose = FILTER.pose(mean, ahead) + innovation
    H = gradient(lambda z: FILTER.pose(z, ahead), mean)
    S = H @ P @ H.T + R
    gain = P @ H.T @ np.linalg.inv(S)
    corrected, normalised = FILTER.correct_pose(Belief(mean, P), pose, R, ahead)
    assert corrected.mean == pytest.approx(mean + gain @ innovation, abs=1e-6)
    assert corrected.covariance == pytest.approx(P - gain @ H @ P, abs=1e-6)
    assert normalised == pytest.approx(innovation @ np.linalg.solve(S, innovation) / 3, rel=1e-4)


SENSOR_FUNCTIONS = {
    "wheel_speed": lambda z: MODEL.C[0] @ z[:N] + z[N],
    "wheel_yaw_rate": lambda z: 1.1 * z[N + 1] * (MODEL.C[1] @ z[:N]),
    "yaw_rate": lambda z: FILTER.twist(z)[1] + z[N + 10],
}


@pytest.mark.parametrize(("sensor", "expected"), SENSOR_FUNCTIONS.items())
@given(mean=means)
def test_twist_correction_equals_the_textbook_filter(sensor, expected, mean):
    assume(abs(FILTER.twist(mean)[1]) > 1e-6)
    rng = np.random.default_rng(2)
    root = 0.1 * rng.normal(size=(SIZE, SIZE))
    P, R = root @ root.T, 1e-4
    h = gradient(expected, mean)
    S = h @ P @ h + R
    corrected, normalised = FILTER.correct(Belief(mean, P), sensor, expected(mean) + 0.05, R)
    assert corrected.mean == pytest.approx(mean + P @ h / S * 0.05, abs=1e-6)
    assert corrected.covariance == pytest.approx(P - np.outer(P @ h, h @ P) / S, abs=1e-6)
    assert normalised == pytest.approx(0.05**2 / S, rel=1e-4)


def test_outlier_corrects_the_state_but_not_slip():
    slip_filter = SlipFilter(MODEL, Estimator(), Compensation(), 1.1)
    mean = NEUTRAL.copy()
    mean[:N] = MODEL.settled_state([0.5, 0.5])
    P = np.diag(np.concatenate([np.full(N, 1e-5), np.full(11, 1e-4), np.full(2, 1e-6), np.full(3, 1e-5)]))
    by_gyro, _ = slip_filter.correct(Belief(mean, P), "yaw_rate", 2.0, 1e-4)
    assert by_gyro.mean[N : N + 11] == pytest.approx(mean[N : N + 11])
    assert slip_filter.twist(by_gyro.mean)[1] == pytest.approx(2.0, abs=0.05)
    by_pose, _ = slip_filter.correct_pose(Belief(mean, P), np.array([0.0, 0.2, 0.0]), 1e-5 * np.eye(3), 0.0)
    assert by_pose.mean[N : N + 11] == pytest.approx(mean[N : N + 11])
    assert by_pose.mean[-2] == pytest.approx(0.2, abs=0.01)


@given(st.floats(-9, 9))
def test_gains_stay_within_their_bounds(value):
    slip_filter = SlipFilter(MODEL, SETTINGS, Compensation(), 1.1)
    mean = NEUTRAL.copy()
    mean[:N] = MODEL.settled_state([0.5, 0.5])
    belief, _ = slip_filter.correct(Belief(mean, np.diag(np.full(SIZE, 10.0))), "yaw_rate", value, 1e-6)
    gains = belief.mean[N + 1 : N + 4]
    assert (gains >= SETTINGS.min_gain).all()
    assert (gains <= SETTINGS.max_gain).all()


TICKS = np.arange(2500)
COMMANDS = np.column_stack([0.5 + 0.2 * np.sin(TICKS / 15), 0.8 * np.sin(TICKS / 25)])


def run(estimator, robot, ticks=200, change=None, command=None, on_update=None):
    """Drive open loop; `change(k, measurement)` replaces measurements, `on_update(k)` runs after each update.

    The command is `command`, or an entry of COMMANDS.
    """
    messages = []
    for k in range(ticks):
        measurement = robot.measure()
        if change is not None:
            measurement = change(k, measurement)
        estimator.advance(robot.time)
        messages += estimator.update(robot.time, measurement)
        if on_update is not None:
            on_update(k)
        applied = COMMANDS[k] if command is None else np.array(command)
        estimator.commands.append(applied)
        robot.advance(applied)
    return messages


def test_exact_measurements_give_the_exact_estimate():
    estimator, robot = StateEstimator(MODEL, Estimator()), IdealRobot(MODEL, np.array([1.0, 2.0, 3.0]))
    messages = run(estimator, robot)
    estimate = estimator.estimate
    assert messages == []
    assert estimate.pose == pytest.approx(robot.poses[-2], abs=1e-9)
    assert estimate.slip.flat == pytest.approx(Slip().flat, abs=1e-9)
    assert estimate.pose_age == 0


@pytest.mark.parametrize("delay", [1, 3, 8])
def test_late_poses_give_the_estimate_of_punctual_poses(delay):
    """Punctual poses up to a tick and the same poses with a delay lead to the same estimate."""
    punctual, delayed = StateEstimator(MODEL, Estimator()), StateEstimator(MODEL, Estimator())
    queue = []

    def delay_poses(k, measurement):
        queue.append(measurement.pose)
        return replace(measurement, pose=queue[k - delay] if k >= delay else (queue[0] if k == 0 else None))

    def stop_early(k, measurement):
        return measurement if k < 100 - delay else replace(measurement, pose=None)

    run(delayed, IdealRobot(MODEL, np.zeros(3), noise=1.0), 100, delay_poses)
    run(punctual, IdealRobot(MODEL, np.zeros(3), noise=1.0), 100, stop_early)
    assert delayed.estimate.pose == pytest.approx(punctual.estimate.pose, abs=1e-12)
    assert delayed.estimate.slip.flat == pytest.approx(punctual.estimate.slip.flat, abs=1e-12)
    assert delayed.estimate.pose_deviation == pytest.approx(punctual.estimate.pose_deviation, abs=1e-12)


def test_delays_of_readings_in_the_configuration_are_compensated():
    """All stamps are current; poses are half a tick old, and wheel speeds have that lag and a scale error."""
    responses = SensorResponses(pose=PoseResponse(delay=0.5 * DT), wheels=WheelResponse(lag=0.5 * DT, scale=1.05))
    estimator, robot = StateEstimator(MODEL, Estimator(), sensors=responses), IdealRobot(MODEL, np.zeros(3))
    wheels = [np.zeros(2)]

    def delay_readings(_, measurement):
        wheels.append(measurement.wheel_twist.value)
        pose = integrate_pose(robot.pose, *robot.twist, -0.5 * DT)
        reading = Stamped(1.05 * 0.5 * (wheels[-1] + wheels[-2]), robot.time)
        return replace(measurement, pose=Stamped(pose, robot.time), wheel_twist=reading)

    run(estimator, robot, 200, delay_readings)
    # Without the correction, the errors would be 5 mm (half a tick of motion) and 25 mm/s.
    assert estimator.estimate.pose[:2] == pytest.approx(robot.poses[-2][:2], abs=5e-4)
    assert estimator.estimate.slip.v_offset == pytest.approx(0.0, abs=1e-3)


SLIP = Slip(v_offset=0.04, longitudinal_gain=0.985, yaw_gain=0.85, side_slip=0.08)
# The same robot with its load ahead or to the left, or with a load that shifts during acceleration.
LOADED = [replace(SLIP, turn_ahead=0.05), replace(SLIP, turn_left=0.05), replace(SLIP, load_shift=0.05)]


@pytest.mark.long
@pytest.mark.parametrize("slip", [SLIP, *LOADED], ids=["middle", "ahead", "left", "dips"])
def test_turning_point_and_slip_are_estimated_within_two_deviations(slip):
    """The error of each value is below two standard deviations; that of the turning point is below 15 mm."""
    estimator = StateEstimator(MODEL, Estimator())
    run(estimator, IdealRobot(MODEL, np.zeros(3), slip=slip, noise=1.0), 1500)
    result, deviation = (np.array(part.flat) for part in (estimator.estimate.slip, estimator.estimate.slip_deviation))
    assert (np.abs(result - slip.flat) < 2 * deviation).all()
    assert result[5:7] == pytest.approx([slip.turn_ahead, slip.turn_left], abs=0.015)
    assert result[7] == pytest.approx(slip.load_shift, abs=0.01)


def test_wheel_gain_is_not_attributed_to_slip():
    """Encoders measure the wheels: a wrong gain of the wheels changes omega_gain, not yaw_gain."""

    class NoEvidenceThreshold(Estimator):
        gain_evidence: ClassVar[float] = 0.0

    estimator = StateEstimator(MODEL, NoEvidenceThreshold())
    run(estimator, IdealRobot(MODEL, np.zeros(3), slip=Slip(omega_gain=0.9)), 600)
    assert estimator.estimate.slip.omega_gain == pytest.approx(0.9, abs=0.01)
    assert estimator.estimate.slip.yaw_gain == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("part", "names"),
    [
        ("v_offset", ["v_offset", "longitudinal_gain"]),
        ("yaw_gain", ["omega_gain", "yaw_gain"]),
        ("side_slip", ["side_slip", "turn_ahead", "turn_left", "load_shift", "slide_x", "slide_y"]),
    ],
)
def test_disabled_compensation_keeps_its_slip_at_zero(part, names):
    estimator = StateEstimator(MODEL, Estimator(), Compensation(**{part: False}))
    run(estimator, IdealRobot(MODEL, np.zeros(3), slip=SLIP), 300)
    for name in FLAT_SLIPS:
        assert (getattr(estimator.estimate.slip, name) == getattr(Slip(), name)) == (name in names)


def yaw_gains(temporary, ticks):
    """Return the estimated yaw gain of each tick; the true gain is `temporary` for `ticks` from tick 300 on."""
    estimator, robot = StateEstimator(MODEL, Estimator()), IdealRobot(MODEL, np.zeros(3), noise=1.0)
    results = []

    def change(k, measurement):
        robot.slip = replace(robot.slip, yaw_gain=temporary if 300 <= k < 300 + ticks else 1.0)
        results.append(estimator.estimate.slip.yaw_gain if estimator.ready else 1.0)
        return measurement

    run(estimator, robot, 700, change)
    return np.array(results)


@pytest.mark.parametrize("yaw_gain", [0.35, 0.6, 1.8])
def test_sudden_change_of_surface_is_learned_within_seconds(yaw_gain):
    """A lasting deviation of any size is estimated as slip."""
    result = yaw_gains(yaw_gain, 400)
    assert result[295] == pytest.approx(1.0, abs=0.05)
    assert np.median(result[500:]) == pytest.approx(yaw_gain, rel=0.1)


def test_short_disturbance_does_not_change_slip():
    result = yaw_gains(0.2, 15)
    assert result[300:] == pytest.approx(np.full(400, result[300]), abs=0.1)


def test_yaw_gains_are_frozen_at_low_yaw_rate():
    estimator, robot = StateEstimator(MODEL, Estimator()), IdealRobot(MODEL, np.zeros(3), slip=SLIP, noise=1.0)
    run(estimator, robot, 20, command=(0.5, 0.03))
    first, gains = estimator.estimate, estimator.nodes[-1].posterior.mean[[N + 1, N + 3]]
    run(estimator, robot, 280, command=(0.5, 0.03))
    second = estimator.estimate
    assert (estimator.nodes[-1].posterior.mean[[N + 1, N + 3]] == gains).all()
    assert second.slip_deviation.yaw_gain <= first.slip_deviation.yaw_gain
    assert second.slip.v_offset != first.slip.v_offset


def test_innovations_are_chi_squared_distributed():
    """For a robot with the noise that the filter assumes, the mean over seeds is inside its 99.9 % interval.

    The mean of n normalised squared innovations of dimension k follows a chi-squared distribution with n k degrees of
    freedom, divided by n k.
    """
    values, dimensions = [], np.array([3 if sensor == "pose" else 1 for sensor in SENSORS])
    for seed in range(10):
        estimator, robot = StateEstimator(MODEL, Estimator()), NoisyRobot(MODEL, Estimator(), seed)

        def record(k, estimator=estimator):
            if k >= 10:
                values.append([estimator.estimate.innovations[sensor] for sensor in SENSORS])

        run(estimator, robot, 150, on_update=record)
    low, high = chi2.interval(0.999, dimensions * len(values))
    total = dimensions * np.sum(values, axis=0)
    assert (low < total).all() and (total < high).all(), dict(
        zip(SENSORS, total / dimensions / len(values), strict=True)
    )
