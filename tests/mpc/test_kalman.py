"""The filter's gradients against finite differences of its own predictions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import integrate_pose, load_model
from mpc.config import Estimator
from mpc.kalman import Belief, VelocityPoseFilter

DT = 0.0202
MODEL = load_model("ssm").with_extra_dead_time([0.01, 0.03]).discretise(DT)
FILTER = VelocityPoseFilter(MODEL, Estimator())
SIZE = MODEL.order + 5
NONE = np.zeros((SIZE, SIZE))
STEP = 1e-6

means = st.lists(st.floats(-1.5, 1.5), min_size=SIZE, max_size=SIZE).map(np.array)
commands = st.lists(st.floats(-1, 1), min_size=2, max_size=2).map(np.array)


def gradient(function, at):
    return np.column_stack([(function(at + STEP * e) - function(at - STEP * e)) / (2 * STEP) for e in np.eye(len(at))])


@given(means, commands, commands)
def test_predicted_covariance_follows_the_gradient_of_the_prediction(mean, recent, older):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(SIZE, SIZE))
    P = root @ root.T
    noise = FILTER.predict(Belief(mean, NONE), recent, older).covariance
    F = gradient(lambda z: FILTER.predict(Belief(z, NONE), recent, older).mean, mean)
    predicted = FILTER.predict(Belief(mean, P), recent, older).covariance
    assert predicted - noise == pytest.approx(F @ P @ F.T, abs=1e-5)
    assert np.linalg.eigvalsh(noise).min() > -1e-15


def test_the_noise_of_the_model_comes_in_through_its_inputs():
    noise = FILTER.predict(Belief(np.zeros(SIZE), NONE), np.zeros(2), np.zeros(2)).covariance
    settings, drive = Estimator(), MODEL.B0 + MODEL.B1
    expected = drive @ np.diag(np.square([settings.v_input_noise, settings.omega_input_noise])) @ drive.T
    assert noise[: MODEL.order, : MODEL.order] == pytest.approx(expected, rel=1e-9)


@given(means, commands)
def test_prediction_moves_the_pose_by_the_mean_of_the_twists(mean, command):
    after = FILTER.predict(Belief(mean, NONE), command, command).mean
    v, omega = 0.5 * (FILTER.twist(mean) + FILTER.twist(after))
    assert after[-3:] == pytest.approx(integrate_pose(mean[-3:], v, omega, DT), abs=1e-12)


@given(means, st.floats(0, 0.9 * DT))
def test_a_pose_corrects_as_the_textbook_says(mean, ahead):
    """Mean and covariance of an extended Kalman filter whose gradient comes from finite differences."""
    rng = np.random.default_rng(1)
    root = 0.1 * rng.normal(size=(SIZE, SIZE))
    P, R = root @ root.T, np.diag([1e-4, 2e-4, 3e-4])
    pose = FILTER.pose_at(Belief(mean, P), ahead) + [0.01, -0.02, 0.03]
    H = gradient(lambda z: FILTER.pose_at(Belief(z, P), ahead), mean)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    corrected = FILTER.correct_pose(Belief(mean, P), pose, R, ahead)
    assert corrected.mean == pytest.approx(mean + gain @ [0.01, -0.02, 0.03], abs=1e-7)
    assert corrected.covariance == pytest.approx(P - gain @ H @ P, abs=1e-7)


@given(means)
def test_twists_correct_as_the_textbook_says(mean):
    rng = np.random.default_rng(2)
    root = 0.1 * rng.normal(size=(SIZE, SIZE))
    P, R = root @ root.T, np.diag([1e-4, 4e-4])
    H = gradient(FILTER.twist, mean)
    values = FILTER.twist(mean) + [0.05, -0.1]
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    corrected = FILTER.correct_twist(Belief(mean, P), values, np.diag(R), [0, 1])
    assert corrected.mean == pytest.approx(mean + gain @ [0.05, -0.1], abs=1e-7)
    one = FILTER.correct_twist(Belief(mean, P), values[1:], np.diag(R)[1:], [1])
    assert abs(FILTER.twist(one.mean)[1] - values[1]) < abs(FILTER.twist(mean)[1] - values[1])


def test_the_angle_between_two_poses_is_the_short_way_round():
    mean = np.zeros(SIZE)
    mean[-1] = 3.1
    P = 0.01 * np.eye(SIZE)
    corrected = FILTER.correct_pose(Belief(mean, P), np.array([0.0, 0.0, -3.1]), 1e-4 * np.eye(3), 0.0)
    assert 3.1 < corrected.mean[-1] < 2 * np.pi - 3.1 + 1e-9
