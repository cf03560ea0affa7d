"""The predicted tracking error: what it grows with, where it is narrow, and what is refused."""

import numpy as np
import pytest

from commands import call, refusal
from diffdrive_mpc import ConfigError, Controller, Trajectory, load_config, load_trajectory
from diffdrive_mpc.models.interface import ReferenceSample
from diffdrive_mpc_extras.predicted_error.calibration import FEATURES, load_calibration, path_features
from diffdrive_mpc_extras.predicted_error.predicted_error import predict_error, predict_tubes
from refusals import one_line_error

POPULATIONS = tuple(load_calibration().populations)
DIRECTIONS = ("lateral", "along")


@pytest.fixture(scope="module")
def controller():
    return Controller("ssm")


def drive(speed=0.4, bend=0.0, change=0.0, seconds=10.0, name="path"):
    """Build a path at constant speed whose curvature is `bend` and swings by `change` [1/m]."""
    t = np.linspace(0.0, seconds, 400)
    omega = speed * (bend + change * np.sin(2.0 * t))
    theta = np.concatenate([[0.0], np.cumsum((omega[1:] + omega[:-1]) / 2 * np.diff(t))])
    middle = (theta[1:] + theta[:-1]) / 2
    x, y = (np.concatenate([[0.0], np.cumsum(speed * f(middle) * np.diff(t))]) for f in (np.cos, np.sin))
    return Trajectory.from_arrays(t, x, y, theta, np.full_like(t, speed), omega, name=name)


@pytest.mark.parametrize("population", POPULATIONS)
@pytest.mark.parametrize(
    ("calm", "hard"),
    [({"speed": 0.3}, {"speed": 0.9}), ({"bend": 0.2}, {"bend": 1.5}), ({"bend": 0.5}, {"bend": 0.5, "change": 1.5})],
    ids=["speed", "curvature", "change of curvature"],
)
def test_the_tube_is_wider_where_the_path_is_harder(controller, population, calm, hard):
    easy, difficult = (predict_error(controller, drive(**path), population) for path in (calm, hard))
    assert difficult.lateral.everywhere.mean() > 1.1 * easy.lateral.everywhere.mean()


@pytest.mark.parametrize("population", POPULATIONS)
def test_features_and_coefficients_are_not_negative(population):
    """So the width is monotone in each feature."""
    twist = np.random.default_rng(3).uniform(-1.5, 1.5, (500, 2))
    features = path_features(twist, 0.02, load_config("ssm"), np.array([0.14, 0.08]))
    assert features.shape == (500, len(FEATURES))
    assert (features >= 0.0).all()
    for direction in DIRECTIONS:
        scale = getattr(load_calibration().population(population), direction)
        assert (scale.row >= 0.0).all()
        assert scale.everywhere > scale.at_each_place


def along_path(predicted, direction, places):
    """Return widths at places of a path [m], each given as a ratio of the whole path."""
    share = predicted.arc_length / predicted.arc_length[-1]
    return np.interp(places, share, getattr(predicted, direction).everywhere)


@pytest.mark.parametrize("population", POPULATIONS)
@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("name", ["square", "s", "cane"])
def test_a_shipped_path_driven_faster_is_nowhere_narrower(controller, name, population, direction):
    path = load_trajectory(name, controller.config)
    t = np.linspace(0.0, path.duration, 1500)
    sample = path.sample(t)
    widths = []
    for slower in (2.0, 1.5, 1.0):
        timed = Trajectory.from_arrays(slower * t, *sample.pose.T, *(sample.twist / slower).T, name=name)
        widths.append(along_path(predict_error(controller, timed, population), direction, np.linspace(0, 1, 80)))
    assert (np.diff(widths, axis=0) >= -1e-9).all()


def test_turns_driven_before_make_a_later_turn_narrower(controller):
    """The exception: slip was learned from them."""
    t = np.linspace(0.0, 20.0, 2000)
    last = []
    for before in (0.0, 1.0):
        omega = 0.4 * np.where(t > 15.0, 1.0, np.where(t < 8.0, before, 0.0))
        theta = np.cumsum(omega) * (t[1] - t[0])
        x, y = (np.cumsum(0.4 * f(theta)) * (t[1] - t[0]) for f in (np.cos, np.sin))
        path = Trajectory.from_arrays(t, x, y, theta, np.full_like(t, 0.4), omega, name="turns")
        last.append(predict_error(controller, path).lateral.everywhere[-200:])
    assert (last[1] < last[0]).all()


def test_an_assumed_model_is_refused():
    with one_line_error(ValueError, match="provenance.origin is assumed"):
        predict_error(Controller("kinematic"), "circle")


def with_delay(controller, delay):
    """Return a controller whose model has this dead time plus lag of omega [s]."""
    model = controller.model
    return Controller(controller.config, model.with_extra_dead_time([0.0, delay - model.lag[1]]))


def test_a_robot_later_than_the_calibration_is_predicted_with_a_warning(controller):
    late = predict_error(with_delay(controller, 0.309), drive(bend=0.5, change=0.5))
    (warning,) = late.warnings
    assert "dead time plus lag of omega is 0.309 s, in the calibration 0.06 to 0.294 s" in warning
    assert predict_error(with_delay(controller, 0.2), drive(bend=0.5, change=0.5)).warnings == ()


def test_a_model_without_its_lag_gets_no_narrower_tube_than_the_least_of_the_calibration(controller):
    calibrated, path = load_calibration(), drive(change=1.0)
    none, least = (
        predict_tubes(path, controller.config, np.array(lag), "drawn", calibrated)
        for lag in ((0.0, 0.0), (calibrated.calibrated.lag_v[0], calibrated.calibrated.lag_omega[0]))
    )
    np.testing.assert_array_equal(none.along.everywhere, least.along.everywhere)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ({"speed": 1.2}, ["speed reaches 1.2 m/s"]),
        ({"speed": 0.8, "bend": 1.5}, ["yaw rate reaches 1.2 rad/s"]),
        ({"speed": 1.0, "bend": 1.2}, ["speed", "yaw rate"]),
        ({"speed": 0.8, "bend": 1.25}, []),
        ({"speed": 0.05}, []),
    ],
    ids=["speed", "yaw rate", "both", "at the bounds", "slow"],
)
def test_a_path_faster_than_the_calibration_is_predicted_with_a_warning(controller, path, words):
    predicted = predict_error(controller, drive(**path))
    assert len(predicted.warnings) == len(words)
    for word, warning in zip(words, predicted.warnings, strict=True):
        assert word in warning
    assert np.isfinite(predicted.lateral.everywhere).all()


class Standing:
    """A reference that stands where `value` says, and lasts as long as it is told."""

    name = "standing"

    def __init__(self, duration, value=0.0):
        self.duration, self.value = duration, value

    def sample(self, times):
        n = np.size(times)
        return ReferenceSample(np.full((n, 3), self.value), np.zeros((n, 2)), np.zeros(n))


def test_a_million_points_end_in_one_line_and_two_hours_are_predicted(controller):
    t = np.linspace(0.0, 3600.0, 1_000_000)
    with one_line_error(ConfigError, "at most 500,000"):
        Trajectory.from_arrays(t, 0.3 * t, np.zeros_like(t))
    assert np.isfinite(predict_error(controller, Standing(7200.0)).lateral.everywhere).all()


def test_it_prints_widths_and_reasons_and_writes_figure_and_rows(tmp_path):
    printed = call("predict-error", "--trajectory", "s", "--population", "drawn", "--out", tmp_path)
    assert "lateral: worst after" in printed and "along: worst after" in printed
    assert (tmp_path / "predicted-error.png").read_bytes().startswith(b"\x89PNG")
    rows = np.genfromtxt(tmp_path / "predicted-error.csv", delimiter=",", names=True)
    assert (rows["lateral_everywhere"] > rows["lateral"]).all()
    assert rows["s"][-1] == pytest.approx(6.28, abs=0.01)
    assert f"{1e3 * rows['lateral_everywhere'].max():.1f}" in printed


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--trajectory", "s", "--population", "mine"], "unknown population 'mine': give drawn"),
        (["--trajectory", "nan.csv"], "nan.csv"),
    ],
)
def test_mistakes_end_in_one_line(tmp_path, monkeypatch, words, complaint):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nan.csv").write_text("t,x,y,theta\n0,0,0,0\n1,nan,0,0\n2,1,0,0\n")
    assert complaint in refusal("predict-error", *words, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
