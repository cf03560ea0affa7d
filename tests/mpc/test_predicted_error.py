"""The predicted tracking error: what it grows with, where it is narrow, and what is refused."""

import numpy as np
import pytest

from diffdrive_mpc import Controller, Trajectory, load_config
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import ReferenceSample
from diffdrive_mpc.mpc.predicted_error.calibration import ErrorScale, load_calibration
from diffdrive_mpc.mpc.predicted_error.features import FEATURES, path_features

POPULATIONS = tuple(load_calibration().populations)
DIRECTIONS = ("lateral", "along")


@pytest.fixture(scope="module")
def controller():
    return Controller("ssm")


def drive(speed=0.4, bend=0.0, change=0.0, seconds=10.0, name="path"):
    """A path at constant speed whose curvature is `bend` and swings by `change` [1/m]."""
    t = np.linspace(0.0, seconds, 400)
    omega = speed * (bend + change * np.sin(2.0 * t))
    theta = np.concatenate([[0.0], np.cumsum((omega[1:] + omega[:-1]) / 2 * np.diff(t))])
    middle = (theta[1:] + theta[:-1]) / 2
    x, y = (np.concatenate([[0.0], np.cumsum(speed * f(middle) * np.diff(t))]) for f in (np.cos, np.sin))
    return Trajectory.from_arrays(t, x, y, theta, np.full_like(t, speed), omega, name=name)


@pytest.mark.parametrize("population", POPULATIONS)
@pytest.mark.parametrize(
    ("calm", "hard"),
    [
        ({"speed": 0.3}, {"speed": 0.9}),
        ({"bend": 0.2}, {"bend": 1.5}),
        ({"bend": 0.5}, {"bend": 0.5, "change": 1.5}),
    ],
    ids=["speed", "curvature", "change of curvature"],
)
def test_the_tube_is_wider_where_the_path_is_harder(controller, population, calm, hard):
    easy, difficult = (controller.predict_error(drive(**path), population) for path in (calm, hard))
    assert difficult.lateral.everywhere.mean() > 1.1 * easy.lateral.everywhere.mean()


@pytest.mark.parametrize("population", POPULATIONS)
def test_dead_time_widens_the_tube(population):
    path = drive(bend=0.8, change=1.5)
    widths = []
    for dead_time in (0.0, 0.1, 0.2):
        config = load_config("ssm", {"extra_dead_time.v": dead_time, "extra_dead_time.omega": dead_time})
        widths.append(Controller(config).predict_error(path, population).lateral.everywhere.max())
    assert widths == sorted(widths)
    assert widths[2] > 1.03 * widths[0]


@pytest.mark.parametrize("population", POPULATIONS)
def test_no_feature_makes_the_tube_narrower(population):
    """Coefficients and features are not negative, so the width is monotone in each."""
    twist = np.random.default_rng(3).uniform(-1.5, 1.5, (500, 2))
    features = path_features(twist, 0.02, load_config("ssm"), np.array([0.14, 0.08]))
    assert features.shape == (500, len(FEATURES))
    assert (features >= 0.0).all()
    for direction in DIRECTIONS:
        scale = getattr(load_calibration().population(population), direction)
        assert (scale.row >= 0.0).all()
        assert scale.everywhere > scale.at_each_place


def test_a_straight_slow_path_has_a_narrow_tube(controller):
    slow = controller.predict_error(drive(speed=0.1), "own")
    assert slow.lateral.at_each_place.max() < 0.005
    assert slow.lateral.everywhere.max() < 0.01


def test_the_worst_place_is_where_the_path_turns(controller):
    """A straight, a quarter of a circle, a straight: the tube is widest in the curve, and says so."""
    predicted = controller.predict_error("square", "own")
    widest = predicted.widest("lateral")
    assert predicted.lateral.everywhere[widest.index] == predicted.lateral.everywhere.max()
    assert sum(widest.reasons.values()) == pytest.approx(1.0)
    assert next(iter(widest.reasons)) in FEATURES
    assert "m (" in widest.sentence
    assert FEATURES[next(iter(widest.reasons))] in widest.sentence


def test_shapes_and_determinism(controller):
    first, second = (controller.predict_error(drive(bend=0.5), "drawn") for _ in range(2))
    count = len(first.time)
    assert first.pose.shape == (count, 3)
    assert first.twist.shape == (count, 2)
    for direction in DIRECTIONS:
        tube, again = getattr(first, direction), getattr(second, direction)
        assert tube.at_each_place.shape == tube.everywhere.shape == (count,)
        assert (tube.everywhere > tube.at_each_place).all()
        assert tube.everywhere.tobytes() == again.everywhere.tobytes()
        np.testing.assert_allclose(sum(tube.shares.values()), 1.0)


def test_a_prediction_changes_nothing_of_a_drive(controller):
    controller.start("circle", 0.0)
    controller.predict_error("square")
    assert controller.reference.name == "circle"


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
    with pytest.raises(ConfigError, match="at most 500,000") as error:
        Trajectory.from_arrays(t, 0.3 * t, np.zeros_like(t))
    assert "\n" not in str(error.value)
    assert np.isfinite(controller.predict_error(Standing(7200.0)).lateral.everywhere).all()


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        (Standing(5.0, np.nan), "not finite"),
        (Standing(0.0), "it lasts 0 s"),
        (Standing(np.nan), "it lasts nan s"),
        (Standing(1e5), "give it in parts"),
        (Trajectory.from_waypoints([[0, 0], [9, 0]], speed=3.0), "limits.v"),
    ],
)
def test_what_cannot_be_predicted_ends_in_one_line(controller, reference, words):
    with pytest.raises(ValueError, match=words) as error:
        controller.predict_error(reference)
    assert "\n" not in str(error.value)


def test_unknown_names_end_in_one_line(controller):
    with pytest.raises(ConfigError, match="give drawn or own"):
        controller.predict_error("circle", "mine")
    with pytest.raises(ValueError, match="unknown feature 'luck'"):
        ErrorScale(coefficients={"luck": 1.0, "floor": 1.0}, at_each_place=1.0, everywhere=2.0)
    with pytest.raises(ValueError, match="floor has to be above zero"):
        ErrorScale(coefficients={"speed": 1.0}, at_each_place=1.0, everywhere=2.0)
