"""`diffdrive-mpc predict-error`: features and widths of the tubes, warnings and errors."""

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


def make_path(speed=0.4, curvature=0.0, amplitude=0.0, seconds=10.0, name="path"):
    """Build a path at constant speed [m/s] with a mean curvature and an oscillation of this amplitude [1/m]."""
    t = np.linspace(0.0, seconds, 400)
    omega = speed * (curvature + amplitude * np.sin(2.0 * t))
    theta = np.concatenate([[0.0], np.cumsum((omega[1:] + omega[:-1]) / 2 * np.diff(t))])
    middle = (theta[1:] + theta[:-1]) / 2
    x, y = (np.concatenate([[0.0], np.cumsum(speed * f(middle) * np.diff(t))]) for f in (np.cos, np.sin))
    return Trajectory.from_arrays(t, x, y, theta, np.full_like(t, speed), omega, name=name)


@pytest.mark.parametrize("population", POPULATIONS)
@pytest.mark.parametrize(
    ("easy", "difficult"),
    [
        ({"speed": 0.3}, {"speed": 0.9}),
        ({"curvature": 0.2}, {"curvature": 1.5}),
        ({"curvature": 0.5}, {"curvature": 0.5, "amplitude": 1.5}),
    ],
    ids=["speed", "curvature", "change of curvature"],
)
def test_tube_is_wider_on_a_more_difficult_path(controller, population, easy, difficult):
    narrow, wide = (predict_error(controller, make_path(**path), population) for path in (easy, difficult))
    assert wide.lateral.everywhere.mean() > 1.1 * narrow.lateral.everywhere.mean()


@pytest.mark.parametrize("population", POPULATIONS)
def test_features_and_coefficients_are_not_negative(population):
    """The width increases with each feature."""
    twist = np.random.default_rng(3).uniform(-1.5, 1.5, (500, 2))
    features = path_features(twist, 0.02, load_config("ssm"), np.array([0.14, 0.08]))
    assert features.shape == (500, len(FEATURES))
    assert (features >= 0.0).all()
    for direction in DIRECTIONS:
        scale = getattr(load_calibration().population(population), direction)
        assert (scale.row >= 0.0).all()
        assert scale.everywhere > scale.at_each_place


def widths_at(predicted, direction, fractions):
    """Return half widths [m] at `fractions` of the path length."""
    fraction = predicted.arc_length / predicted.arc_length[-1]
    return np.interp(fractions, fraction, getattr(predicted, direction).everywhere)


@pytest.mark.parametrize("population", POPULATIONS)
@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("name", ["square", "s", "cane"])
def test_higher_speed_does_not_narrow_the_tube_of_a_shipped_path(controller, name, population, direction):
    path = load_trajectory(name, controller.config)
    t = np.linspace(0.0, path.duration, 1500)
    sample = path.sample(t)
    widths = []
    for factor in (2.0, 1.5, 1.0):
        timed_path = Trajectory.from_arrays(factor * t, *sample.pose.T, *(sample.twist / factor).T, name=name)
        widths.append(widths_at(predict_error(controller, timed_path, population), direction, np.linspace(0, 1, 80)))
    assert (np.diff(widths, axis=0) >= -1e-9).all()


def test_earlier_turns_narrow_the_tube_of_a_later_turn(controller):
    """The controller learns slip in the earlier turns."""
    t = np.linspace(0.0, 20.0, 2000)
    final_widths = []
    for curvature in (0.0, 1.0):
        omega = 0.4 * np.where(t > 15.0, 1.0, np.where(t < 8.0, curvature, 0.0))
        theta = np.cumsum(omega) * (t[1] - t[0])
        x, y = (np.cumsum(0.4 * f(theta)) * (t[1] - t[0]) for f in (np.cos, np.sin))
        path = Trajectory.from_arrays(t, x, y, theta, np.full_like(t, 0.4), omega, name="turns")
        final_widths.append(predict_error(controller, path).lateral.everywhere[-200:])
    assert (final_widths[1] < final_widths[0]).all()


def test_assumed_model_raises_value_error():
    with one_line_error(ValueError, match="provenance.origin is assumed"):
        predict_error(Controller("kinematic"), "circle")


def with_delay(controller, delay):
    """Return a controller whose model has this sum of dead time and lag of omega [s]."""
    model = controller.model
    return Controller(controller.config, model.with_extra_dead_time([0.0, delay - model.lag[1]]))


def test_delay_above_the_calibrated_range_gives_a_warning(controller):
    path = make_path(curvature=0.5, amplitude=0.5)
    (warning,) = predict_error(with_delay(controller, 0.309), path).warnings
    assert "dead time plus lag of omega is 0.309 s, the calibrated range is 0.06 to 0.294 s" in warning
    assert predict_error(with_delay(controller, 0.2), path).warnings == ()


def test_lag_below_the_calibrated_range_gives_the_tube_of_the_minimum_lag(controller):
    calibration, path = load_calibration(), make_path(amplitude=1.0)
    without_lag, with_min_lag = (
        predict_tubes(path, controller.config, np.array(lag), "drawn", calibration)
        for lag in ((0.0, 0.0), (calibration.calibrated.lag_v[0], calibration.calibrated.lag_omega[0]))
    )
    np.testing.assert_array_equal(without_lag.along.everywhere, with_min_lag.along.everywhere)


@pytest.mark.parametrize(
    ("path", "texts"),
    [
        ({"speed": 1.2}, ["speed reaches 1.2 m/s"]),
        ({"speed": 0.8, "curvature": 1.5}, ["yaw rate reaches 1.2 rad/s"]),
        ({"speed": 1.0, "curvature": 1.2}, ["speed", "yaw rate"]),
        ({"speed": 0.8, "curvature": 1.25}, []),
        ({"speed": 0.05}, []),
    ],
    ids=["speed", "yaw rate", "both", "at the bounds", "slow"],
)
def test_speed_above_the_calibrated_range_gives_a_warning(controller, path, texts):
    predicted = predict_error(controller, make_path(**path))
    assert len(predicted.warnings) == len(texts)
    for text, warning in zip(texts, predicted.warnings, strict=True):
        assert text in warning
    assert np.isfinite(predicted.lateral.everywhere).all()


class ConstantPose:
    """Reference at rest, with all pose values equal to `value` and the given duration [s]."""

    name = "constant pose"

    def __init__(self, duration, value=0.0):
        self.duration, self.value = duration, value

    def sample(self, times):
        n = np.size(times)
        return ReferenceSample(np.full((n, 3), self.value), np.zeros((n, 2)), np.zeros(n))


def test_path_with_too_many_points_raises_config_error_and_two_hours_are_predicted(controller):
    t = np.linspace(0.0, 3600.0, 1_000_000)
    with one_line_error(ConfigError, "at most 500,000"):
        Trajectory.from_arrays(t, 0.3 * t, np.zeros_like(t))
    assert np.isfinite(predict_error(controller, ConstantPose(7200.0)).lateral.everywhere).all()


def test_command_prints_widths_and_reasons_and_writes_figure_and_rows(tmp_path):
    output = call("predict-error", "--trajectory", "s", "--population", "drawn", "--out", tmp_path)
    assert "lateral: worst after" in output and "along: worst after" in output
    assert (tmp_path / "predicted-error.png").read_bytes().startswith(b"\x89PNG")
    rows = np.genfromtxt(tmp_path / "predicted-error.csv", delimiter=",", names=True)
    assert (rows["lateral_everywhere"] > rows["lateral"]).all()
    assert rows["s"][-1] == pytest.approx(6.28, abs=0.01)
    assert f"{1e3 * rows['lateral_everywhere'].max():.1f}" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--trajectory", "s", "--population", "mine"], "unknown population 'mine': give drawn"),
        (["--trajectory", "nan.csv"], "nan.csv"),
    ],
)
def test_invalid_arguments_end_in_a_one_line_error(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nan.csv").write_text("t,x,y,theta\n0,0,0,0\n1,nan,0,0\n2,1,0,0\n")
    assert message in refusal("predict-error", *arguments, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
