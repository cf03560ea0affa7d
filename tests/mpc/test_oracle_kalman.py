"""The oracle's filter against finite differences of its own predictions, and the textbook."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from diffdrive_mpc.models import integrate_pose, load_model
from diffdrive_mpc.mpc.config.schema import Compensation, Estimator
from oracle.kalman import Belief, SlipFilter

DT = 0.0202
MODEL = load_model("ssm").with_extra_dead_time([0.01, 0.03]).discretise(DT)
# Nothing surprises it, and nothing is too slow: its corrections are those of the textbook.
SETTINGS = Estimator(surprise=1e9, min_yaw_rate=1e-9, min_speed=1e-9)
FILTER = SlipFilter(MODEL, SETTINGS, Compensation(), 1.1)
N = MODEL.order
SIZE = N + 14
NONE = np.zeros((SIZE, SIZE))
STEP = 1e-6
NEUTRAL = np.concatenate([np.zeros(N), [0, 1, 1, 1, *[0] * 7], np.zeros(3)])

means = st.lists(st.floats(-0.5, 0.5), min_size=SIZE, max_size=SIZE).map(lambda z: NEUTRAL + np.array(z))
commands = st.lists(st.floats(-1, 1), min_size=2, max_size=2).map(np.array)


def gradient(function, at):
    columns = [(function(at + STEP * e) - function(at - STEP * e)) / (2 * STEP) for e in np.eye(len(at))]
    return np.column_stack(columns) if np.ndim(columns[0]) else np.array(columns)


@given(means, commands, commands)
def test_predicted_covariance_follows_the_gradient_of_the_prediction(mean, recent, older):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(SIZE, SIZE))
    P = root @ root.T
    noise = FILTER.predict(Belief(mean, NONE), recent, older).covariance
    acceleration = FILTER.acceleration(mean, recent, older)
    F = gradient(lambda z: FILTER.process(z, recent, older, acceleration), mean)
    predicted = FILTER.predict(Belief(mean, P), recent, older).covariance
    assert predicted - noise == pytest.approx(F @ P @ F.T, abs=1e-5)
    assert np.linalg.eigvalsh(noise).min() > -1e-15


def test_the_noise_of_the_model_comes_in_through_its_inputs():
    noise = FILTER.predict(Belief(NEUTRAL, NONE), np.zeros(2), np.zeros(2)).covariance
    settings, drive = Estimator(), MODEL.B0 + MODEL.B1
    expected = drive @ np.diag(np.square([settings.v_input_noise, settings.omega_input_noise])) @ drive.T
    assert noise[:N, :N] == pytest.approx(expected, rel=1e-9)


@given(means, commands)
def test_prediction_moves_the_turning_point_by_the_mean_of_the_twists(mean, command):
    """Without side-slip and slide it moves straight on, on a circle of its own about which the origin is carried."""
    mean[[N + 4, N + 8, N + 9]] = 0.0
    after = FILTER.predict(Belief(mean, NONE), command, command).mean
    slip, twists = FILTER.slip(mean), [FILTER.twist(mean), FILTER.twist(after)]
    (v, omega), acceleration = 0.5 * (twists[0] + twists[1]), (twists[1] - twists[0])[0] / DT
    place = np.array([slip.turn_ahead - slip.load_shift * acceleration, slip.turn_left])

    def point(pose):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        return np.array([*(pose[:2] + [c * place[0] - s * place[1], s * place[0] + c * place[1]]), pose[2]])

    moved = integrate_pose(point(mean[-3:]), v - omega * slip.turn_left, omega, DT)
    assert point(after[-3:]) == pytest.approx(moved, abs=1e-12)


def test_a_robot_that_turns_slides_across_its_heading_and_half_as_far_along():
    mean = NEUTRAL.copy()
    mean[:N] = MODEL.settled_state([0.0, 0.5])
    for slide, heading, share in ((0.1, 0.0, 0.5), (0.1, np.pi / 2, 1.0)):
        mean[N + 8], mean[-1] = 0.0, heading
        level, omega = FILTER.pose(mean, DT), FILTER.twist(mean)[1]
        mean[N + 8] = slide
        after = FILTER.pose(mean, DT)
        assert after[-1] - heading == pytest.approx(omega * DT)
        assert after[0] - level[0] == pytest.approx(share * slide * (np.hypot(omega, 0.05) - 0.05) * DT, rel=1e-4)


def test_a_robot_at_rest_learns_nothing_of_its_gains_and_forgets_nothing():
    before = Belief(NEUTRAL, np.diag(np.full(SIZE, 0.01)))
    settled = SlipFilter(MODEL, Estimator(), Compensation(), 1.1).predict(before, np.zeros(2), np.zeros(2))
    growth = np.diag(settled.covariance - before.covariance)[N : N + 11]
    assert (growth[[0, 10]] > 0).all()
    assert growth[1:10] == pytest.approx(0, abs=1e-15)


@given(means, st.floats(0, 0.9 * DT))
def test_a_pose_corrects_as_the_textbook_says(mean, ahead):
    """Mean and covariance of an extended Kalman filter whose gradient comes from finite differences."""
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


def wheel_speed(z):
    return MODEL.C[0] @ z[:N] + z[N]


def wheel_yaw_rate(z):
    return 1.1 * z[N + 1] * (MODEL.C[1] @ z[:N])


def gyro(z):
    return FILTER.twist(z)[1] + z[N + 10]


@pytest.mark.parametrize(
    ("sensor", "expected"), [("wheel_speed", wheel_speed), ("wheel_yaw_rate", wheel_yaw_rate), ("yaw_rate", gyro)]
)
@given(mean=means)
def test_twists_correct_as_the_textbook_says(sensor, expected, mean):
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


def test_a_surprise_moves_the_robot_and_not_its_slip():
    wary = SlipFilter(MODEL, Estimator(), Compensation(), 1.1)
    mean = NEUTRAL.copy()
    mean[:N] = MODEL.settled_state([0.5, 0.5])
    P = np.diag(np.concatenate([np.full(N, 1e-5), np.full(11, 1e-4), np.full(3, 1e-5)]))
    after, _ = wary.correct(Belief(mean, P), "yaw_rate", 2.0, 1e-4)
    assert after.mean[N : N + 11] == pytest.approx(mean[N : N + 11])
    assert wary.twist(after.mean)[1] == pytest.approx(2.0, abs=0.05)
    moved, _ = wary.correct_pose(Belief(mean, P), np.array([0.0, 0.2, 0.0]), 1e-5 * np.eye(3), 0.0)
    assert moved.mean[N : N + 11] == pytest.approx(mean[N : N + 11])
    assert moved.mean[-2] == pytest.approx(0.2, abs=0.01)


def test_a_surprise_that_lasts_is_learned_from_and_a_new_one_is_not():
    wary = SlipFilter(MODEL, Estimator(lasting_surprise=10 * DT, omega_input_noise=0.01), Compensation(), 1.1)
    mean = NEUTRAL.copy()
    mean[:N] = MODEL.settled_state([0.5, 0.5])
    command = np.array([0.5, 0.5])
    belief = Belief(mean, np.diag(np.concatenate([np.full(N, 1e-5), np.full(11, 1e-4), np.full(3, 1e-5)])))
    gains = []
    for _ in range(14):
        belief, _ = wary.correct(wary.predict(belief, command, command), "yaw_rate", 3.0, 1e-6)
        gains.append(belief.mean[N + 3])
    assert gains[:10] == pytest.approx([1.0] * 10)
    assert min(gains[10:]) > 1.1
    calm, _ = wary.correct(belief, "yaw_rate", wary.twist(belief.mean)[1] + belief.mean[N + 10], 1e-6)
    again, _ = wary.correct(calm, "yaw_rate", 6.0, 1e-6)
    assert again.mean[N + 3] == pytest.approx(calm.mean[N + 3])


@given(st.floats(-9, 9))
def test_gains_stay_such_as_a_robot_can_have(value):
    settings = Estimator(surprise=1e9)
    trusting = SlipFilter(MODEL, settings, Compensation(), 1.1)
    mean = NEUTRAL.copy()
    mean[:N] = MODEL.settled_state([0.5, 0.5])
    belief, _ = trusting.correct(Belief(mean, np.diag(np.full(SIZE, 10.0))), "yaw_rate", value, 1e-6)
    gains = belief.mean[N + 1 : N + 4]
    assert (gains >= settings.min_gain).all()
    assert (gains <= settings.max_gain).all()


def test_the_angle_between_two_poses_is_the_short_way_round():
    mean = NEUTRAL.copy()
    mean[-1] = 3.1
    P = 0.01 * np.eye(SIZE)
    corrected, _ = FILTER.correct_pose(Belief(mean, P), np.array([0.0, 0.0, -3.1]), 1e-4 * np.eye(3), 0.0)
    assert 3.1 < corrected.mean[-1] < 2 * np.pi - 3.1 + 1e-9
