"""Torque learning: the resource-allocating network and the torque curves."""

import numpy as np
import pytest

from diffdrive_mpc_extras.terrain import Shear, load_terrain, side_torques
from diffdrive_mpc_extras.torque import MranNetwork, TorqueCurves, load_torque_settings
from diffdrive_mpc_extras.turn_costs import least_radius, load_vehicle

SETTINGS = load_torque_settings()
BOT = load_vehicle("fsu_bot")
VINYL, ASPHALT = load_terrain("vinyl"), load_terrain("asphalt")
STIFF = ASPHALT.model_copy(update={"slip": None, "shear": Shear(mu_outer=1.2, mu_inner=0.8, modulus=4e-4)})
RADII = np.geomspace(0.4, 200.0, 30)


def network(**changes):
    return MranNetwork(SETTINGS.network.model_copy(update=changes))


def learn_function(learner, function, passes=30, rng=None):
    """Train a network with samples of a function in alternating order; return the inputs."""
    x = np.linspace(-1.0, 6.0, 60)
    for k in range(passes):
        for sample in x[:: 1 if k % 2 else -1]:
            learner.learn(sample, function(sample) + (0.0 if rng is None else 0.08 * rng.normal()))
    return x


def settings_with_exponent(value):
    return SETTINGS.model_copy(update={"curves": SETTINGS.curves.model_copy(update={"speed_exponent": value})})


def test_new_unit_compensates_the_error_of_the_sample():
    learner = network(window=1, distance=(0.3, 0.3))
    error = learner.learn(2.0, 0.5)
    assert error == 0.5
    assert learner(2.0) == pytest.approx(0.5)
    assert learner.units.tolist() == [[0.5, 2.0, SETTINGS.network.width[1]]]


@pytest.mark.parametrize(
    "changes", [{"instant_error": 0.6}, {"window_error": 0.6}], ids=["small error", "small error of the window"]
)
def test_unit_is_added_only_if_all_criteria_are_met(changes):
    learner = network(**changes)
    for _ in range(50):
        learner.learn(2.0, 0.5)
    assert len(learner.units) == 0
    assert learner(2.0) == pytest.approx(0.5, abs=0.05), "the offset adapts"


def test_network_learns_a_smooth_curve_from_noisy_samples():
    def curve(x):
        return 0.9 / (1 + np.exp(1.5 * (x - 1.5)))

    learner = network()
    x = learn_function(learner, curve, rng=np.random.default_rng(3))
    assert np.sqrt(np.mean((learner(x) - curve(x)) ** 2)) < 0.03
    assert len(learner.units) < 20


def test_update_of_the_offset_is_a_kalman_update():
    # A network that cannot add units has a single parameter with a variance.
    learner = network(instant_error=9.0, drift=0.0)
    settings = SETTINGS.network
    learner.learn(0.0, 1.0)
    assert learner.offset == pytest.approx(settings.doubt / (settings.doubt + settings.noise**2))
    for _ in range(99):
        learner.learn(0.0, 1.0)
    # The prior has the weight of noise^2 / doubt samples with the value zero.
    assert learner.offset == pytest.approx(100 / (100 + settings.noise**2 / settings.doubt))


def test_samples_that_are_not_finite_are_ignored():
    learner = network(window=1)
    learner.learn(1.0, 0.4)
    units = learner.units
    for x, y in ((np.nan, 0.0), (1.0, np.inf), (np.inf, 0.1)):
        assert np.isnan(learner.learn(x, y))
    assert np.array_equal(learner.units, units)
    learner.learn(1.0, 1e300)
    assert np.isfinite(learner(np.linspace(-5, 8, 20))).all()


def test_prior_is_learned_from_30_radii():
    curves = TorqueCurves.from_prior(BOT, VINYL)
    expected = side_torques(BOT, VINYL, RADII, SETTINGS.curves.speed)
    assert np.sqrt(np.mean((curves.outer(RADII) - expected.outer) ** 2)) < 0.03 * BOT.torque_limit
    assert np.sqrt(np.mean((curves.inner(RADII) - expected.inner) ** 2)) < 0.03 * BOT.torque_limit
    assert max(curves.units) <= SETTINGS.network.most_units
    assert curves.least_radius() == 0.0


def simulate_drive(terrain, hold=3.5, dt=0.02):
    """Return commands (n, 2), torques of the left and right side (n,) [N m], and the sample time [s]."""
    radii = np.geomspace(200.0, 0.5, 24) * np.tile([1, -1], 12)
    speeds = np.tile([0.2, 0.4, 0.6], 8)
    torques = side_torques(BOT, terrain, radii, speeds)
    count = round(hold / dt)
    left = np.where(radii < 0, torques.outer, torques.inner)
    right = np.where(radii < 0, torques.inner, torques.outer)
    commands = np.repeat(np.stack([speeds, speeds / radii], -1), count, axis=0)
    return commands, np.repeat(left, count), np.repeat(right, count), dt


def test_curves_of_another_terrain_are_learned_from_a_wrong_prior():
    rng, settings = np.random.default_rng(1), settings_with_exponent(0.0)
    curves = TorqueCurves.from_prior(BOT, VINYL, settings)
    commands, left, right, dt = simulate_drive(STIFF)
    noise = 0.15 * rng.normal(size=(2, len(left)))
    count = curves.learn_drive(commands, left + noise[0], right + noise[1], dt)
    assert count == pytest.approx((1 - 1.5 / 3.5) * len(left), rel=0.01)
    outer = np.minimum(side_torques(BOT, STIFF, RADII, 0.4).outer, BOT.torque_limit)
    assert np.sqrt(np.mean((curves.outer(RADII) - outer) ** 2)) < 0.1 * np.sqrt(np.mean(outer**2))
    expected = least_radius(lambda r: side_torques(BOT, STIFF, r, 0.4).outer, BOT.torque_limit)
    assert curves.least_radius() == pytest.approx(expected, rel=0.2)


def test_rows_in_the_settling_time_are_not_learned():
    curves = TorqueCurves(4.6)
    commands = np.array([[0.4, 0.1]] * 100 + [[0.4, 0.2]] * 100)
    assert curves.learn_drive(commands, np.full(200, -1.0), np.full(200, 2.0), 0.02) == 2 * (100 - 75)


def test_settling_time_removes_the_error_of_lagged_torques():
    commands, left, right, dt = simulate_drive(STIFF)
    lag, (lagged_left, lagged_right) = 0.45, (np.empty_like(left), np.empty_like(right))
    for lagged, steady in ((lagged_left, left), (lagged_right, right)):
        torque = 0.0
        for k, target in enumerate(steady):
            torque += (target - torque) * dt / lag
            lagged[k] = torque
    short_curves = settings_with_exponent(0.0).curves.model_copy(update={"settling": 0.5})
    outer = np.minimum(side_torques(BOT, STIFF, RADII, 0.4).outer, BOT.torque_limit)

    def relative_error(settings):
        curves = TorqueCurves.from_prior(BOT, VINYL, settings)
        curves.learn_drive(commands, lagged_left, lagged_right, dt)
        return np.sqrt(np.mean((curves.outer(RADII) - outer) ** 2) / np.mean(outer**2))

    short_settling = SETTINGS.model_copy(update={"curves": short_curves})
    assert relative_error(settings_with_exponent(0.0)) < 0.07 < relative_error(short_settling)


def test_torques_have_the_symmetries_of_left_right_forward_and_backward_turns():
    curves = TorqueCurves.from_prior(BOT, ASPHALT.model_copy(update={"slip": None}))
    left, right = curves.torques([[0.4, 0.4]])[0], curves.torques([[0.4, -0.4]])[0]
    assert left.tolist() == right[::-1].tolist()
    assert left[1] > 0 > left[0]
    # In a backward counter-clockwise turn, the left wheels are the outer wheels and turn backward.
    backward = curves.torques([[-0.4, 0.4]])[0]
    assert backward.tolist() == [-left[1], -left[0]]
    spot_turn = curves.torques([[0.0, 0.5]])[0]
    assert spot_turn[1] > 0 > spot_turn[0]
    assert curves.torques([[0.0, 0.0]]).tolist() == [[0.0, 0.0]]
    assert np.isfinite(curves.torques([[0.4, 0.0]])).all()
