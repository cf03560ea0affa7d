"""The network that grows and shrinks, and what the torque curves may say."""

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


def swept(result, function, passes=30, rng=None):
    x = np.linspace(-1.0, 6.0, 60)
    for k in range(passes):
        for sample in x[:: 1 if k % 2 else -1]:
            result.learn(sample, function(sample) + (0.0 if rng is None else 0.08 * rng.normal()))
    return x


def with_exponent(value):
    return SETTINGS.model_copy(update={"curves": SETTINGS.curves.model_copy(update={"speed_exponent": value})})


def test_the_first_unit_makes_up_for_the_error_that_called_it():
    learner = network(window=1, distance=(0.3, 0.3))
    error = learner.learn(2.0, 0.5)
    assert error == 0.5
    assert learner(2.0) == pytest.approx(0.5)
    assert learner.units.tolist() == [[0.5, 2.0, SETTINGS.network.width[1]]]


@pytest.mark.parametrize(
    "changes", [{"instant_error": 0.6}, {"window_error": 0.6}], ids=["small error", "small error of the window"]
)
def test_no_unit_is_added_unless_all_criteria_are_met(changes):
    learner = network(**changes)
    for _ in range(50):
        learner.learn(2.0, 0.5)
    assert len(learner.units) == 0
    assert learner(2.0) == pytest.approx(0.5, abs=0.05), "it adapts what it has"


def test_it_learns_a_smooth_curve_from_noise():
    def curve(x):
        return 0.9 / (1 + np.exp(1.5 * (x - 1.5)))

    learner = network()
    x = swept(learner, curve, rng=np.random.default_rng(3))
    assert np.sqrt(np.mean((learner(x) - curve(x)) ** 2)) < 0.03
    assert len(learner.units) < 20


def test_one_update_of_the_offset_alone_is_kalman_s():
    # A network without units that may not grow is one number with a variance.
    learner = network(instant_error=9.0, drift=0.0)
    settings = SETTINGS.network
    learner.learn(0.0, 1.0)
    assert learner.offset == pytest.approx(settings.doubt / (settings.doubt + settings.noise**2))
    for _ in range(99):
        learner.learn(0.0, 1.0)
    # After n equal samples: the prior counts as noise^2 / doubt samples of zero.
    assert learner.offset == pytest.approx(100 / (100 + settings.noise**2 / settings.doubt))


def test_nonsense_is_left_out():
    learner = network(window=1)
    learner.learn(1.0, 0.4)
    before = learner.units
    for x, y in ((np.nan, 0.0), (1.0, np.inf), (np.inf, 0.1)):
        assert np.isnan(learner.learn(x, y))
    assert np.array_equal(learner.units, before)
    learner.learn(1.0, 1e300)
    assert np.isfinite(learner(np.linspace(-5, 8, 20))).all()


def test_the_prior_is_learned_from_30_triplets():
    curves = TorqueCurves.from_prior(BOT, VINYL)
    true = side_torques(BOT, VINYL, RADII, SETTINGS.curves.speed)
    assert np.sqrt(np.mean((curves.outer(RADII) - true.outer) ** 2)) < 0.03 * BOT.torque_limit
    assert np.sqrt(np.mean((curves.inner(RADII) - true.inner) ** 2)) < 0.03 * BOT.torque_limit
    assert max(curves.units) <= SETTINGS.network.most_units
    assert curves.least_radius() == 0.0


def drive(terrain, hold=3.5, dt=0.02):
    radii = np.geomspace(200.0, 0.5, 24) * np.tile([1, -1], 12)
    speeds = np.tile([0.2, 0.4, 0.6], 8)
    torques = side_torques(BOT, terrain, radii, speeds)
    count = round(hold / dt)
    left = np.where(radii < 0, torques.outer, torques.inner)
    right = np.where(radii < 0, torques.inner, torques.outer)
    commands = np.repeat(np.stack([speeds, speeds / radii], -1), count, axis=0)
    return commands, np.repeat(left, count), np.repeat(right, count), dt


def test_another_terrain_is_learned_from_a_prior_that_is_wrong():
    rng, settings = np.random.default_rng(1), with_exponent(0.0)
    curves = TorqueCurves.from_prior(BOT, VINYL, settings)
    commands, left, right, dt = drive(STIFF)
    noise = 0.15 * rng.normal(size=(2, len(left)))
    used = curves.learn_drive(commands, left + noise[0], right + noise[1], dt)
    assert used == pytest.approx((1 - 1.5 / 3.5) * len(left), rel=0.01)
    true = side_torques(BOT, STIFF, RADII, 0.4)
    top = np.minimum(true.outer, BOT.torque_limit)
    assert np.sqrt(np.mean((curves.outer(RADII) - top) ** 2)) < 0.1 * np.sqrt(np.mean(top**2))
    expected = least_radius(lambda r: side_torques(BOT, STIFF, r, 0.4).outer, BOT.torque_limit)
    assert curves.least_radius() == pytest.approx(expected, rel=0.2)


def test_what_follows_a_change_of_the_command_is_not_learned():
    curves = TorqueCurves(4.6)
    commands = np.array([[0.4, 0.1]] * 100 + [[0.4, 0.2]] * 100)
    assert curves.learn_drive(commands, np.full(200, -1.0), np.full(200, 2.0), 0.02) == 2 * (100 - 75)


def test_torques_that_build_up_late_are_learned_as_they_are_in_the_end():
    commands, left, right, dt = drive(STIFF)
    lag, (late_left, late_right) = 0.45, (np.empty_like(left), np.empty_like(right))
    for late, true in ((late_left, left), (late_right, right)):
        now = 0.0
        for k, target in enumerate(true):
            now += (target - now) * dt / lag
            late[k] = now
    hasty = SETTINGS.model_copy(update={"curves": with_exponent(0.0).curves.model_copy(update={"settling": 0.5})})
    top = np.minimum(side_torques(BOT, STIFF, RADII, 0.4).outer, BOT.torque_limit)

    def off(settings):
        curves = TorqueCurves.from_prior(BOT, VINYL, settings)
        curves.learn_drive(commands, late_left, late_right, dt)
        return np.sqrt(np.mean((curves.outer(RADII) - top) ** 2) / np.mean(top**2))

    assert off(with_exponent(0.0)) < 0.07 < off(hasty)


def test_left_right_forward_and_backward_are_one_turn():
    curves = TorqueCurves.from_prior(BOT, ASPHALT.model_copy(update={"slip": None}))
    left, right = curves.torques([[0.4, 0.4]])[0], curves.torques([[0.4, -0.4]])[0]
    assert left.tolist() == right[::-1].tolist()
    assert left[1] > 0 > left[0]
    # Backward and counter-clockwise the left wheels are outside, and turn backward.
    back = curves.torques([[-0.4, 0.4]])[0]
    assert back.tolist() == [-left[1], -left[0]]
    spin = curves.torques([[0.0, 0.5]])[0]
    assert spin[1] > 0 > spin[0]
    assert curves.torques([[0.0, 0.0]]).tolist() == [[0.0, 0.0]]
    assert np.isfinite(curves.torques([[0.4, 0.0]])).all()
