"""Shear under the tyres of a skid-steer: limits, symmetries, balance of power, and what P4 prints."""

import numpy as np
import pytest

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc_extras.terrain import Shear, Terrain, load_terrain, side_torques
from diffdrive_mpc_extras.terrain.turning import floor_forces
from diffdrive_mpc_extras.turn_costs import least_radius, load_vehicle
from refusals import one_line_error

BOT = load_vehicle("fsu_bot")
VINYL, ASPHALT = load_terrain("vinyl"), load_terrain("asphalt")
CENTRED = BOT.model_copy(update={"centre_of_mass": (0.0, 0.0, 0.0)})
RADII = np.geomspace(0.3, 300.0, 25)


def ground(mu=0.6, modulus=1e-3, inner=None, slip=None):
    return Terrain(description="test", shear=Shear(mu_outer=mu, mu_inner=inner or mu, modulus=modulus), slip=slip)


def test_straight_on_costs_drag_and_rolling_alone():
    heavy = CENTRED.model_copy(update={"rolling_coefficient": 0.02})
    torques = side_torques(heavy, ground(), np.inf, 0.4)
    expected = heavy.drag_torque + 0.02 * heavy.wheel_radius * heavy.weight / 2
    assert torques.outer == pytest.approx(expected, rel=1e-9)
    assert torques.inner == pytest.approx(expected, rel=1e-9)


def test_ever_wider_turns_come_to_the_straight():
    far = side_torques(BOT, VINYL, [1e3, 1e5, 1e7], 0.4)
    assert (np.diff(np.abs(far.outer - BOT.drag_torque)) < 0).all()
    assert far.outer[-1] == pytest.approx(BOT.drag_torque, abs=1e-4)


def test_a_locked_vehicle_turned_in_place_meets_coulomb_s_moment():
    # All wheels slide across their lever: moment = mu W times the distance of a wheel from the middle.
    forces = floor_forces(CENTRED, np.full((1, 2), 0.5), 1e-7, np.zeros((1, 2)), np.array([[0.0, 0.0, 0.3]]), (24, 24))
    lever = np.hypot(BOT.track, BOT.wheel_base) / 2
    # A patch of finite size has a slightly larger mean lever.
    assert forces.moment[0] == pytest.approx(-0.5 * BOT.weight * lever, rel=2e-3)
    assert forces.loss[0] == pytest.approx(0.3 * 0.5 * BOT.weight * lever, rel=2e-3)
    assert np.allclose(forces.wrench[0, :2], 0.0, atol=1e-9)


def test_sliding_all_one_way_takes_friction_times_weight():
    forces = floor_forces(CENTRED, np.full((1, 2), 0.7), 1e-7, np.zeros((1, 2)), np.array([[0.3, 0.4, 0.0]]))
    assert forces.wrench[0] == pytest.approx([-0.7 * BOT.weight * 0.6, -0.7 * BOT.weight * 0.8, 0.0], abs=1e-6)


def test_a_stiff_tread_in_a_slow_turn_has_the_coulomb_plateau():
    # Slow, so without centripetal force; K to zero: every tyre slides, mostly across, and the moments balance.
    torques = side_torques(CENTRED.model_copy(update={"drag_torque": 0.0}), ground(0.6, 1e-6), 1.0, 0.01)
    share = BOT.wheel_base / np.hypot(BOT.track, BOT.wheel_base)
    assert torques.outer[0] == pytest.approx(BOT.wheel_radius * 0.6 * BOT.weight / 2 * share, rel=0.02)
    assert torques.inner[0] == pytest.approx(-torques.outer[0], rel=0.02)
    assert torques.twist[0, 2] == pytest.approx(0.01 / (1 + (BOT.wheel_base / BOT.track) ** 2), rel=0.02)


@pytest.mark.parametrize("speed", [0.2, 0.6])
@pytest.mark.parametrize("terrain", [VINYL, ASPHALT.model_copy(update={"slip": None})], ids=["vinyl", "asphalt"])
def test_what_the_motors_give_becomes_heat(terrain, speed):
    torques = side_torques(BOT, terrain, np.concatenate([RADII, -RADII]), speed)
    assert torques.power == pytest.approx(torques.forces.loss + torques.rolling_loss, rel=1e-4)
    assert (torques.forces.loss >= 0).all()


def test_the_floor_gives_what_the_turn_takes():
    torques = side_torques(CENTRED, VINYL, RADII, 0.6)
    u, w, omega = torques.twist.T
    assert torques.forces.wrench[:, 1] == pytest.approx(CENTRED.mass * omega * u, abs=1e-3)
    assert torques.forces.wrench[:, 0] == pytest.approx(-CENTRED.mass * omega * w, abs=1e-3)


def test_left_turns_and_right_turns_are_mirrored():
    left, right = (side_torques(CENTRED, VINYL, sign * RADII, 0.4) for sign in (1, -1))
    assert left.outer == pytest.approx(right.outer, rel=1e-4)
    assert left.inner == pytest.approx(right.inner, rel=1e-4, abs=1e-4)
    assert left.twist == pytest.approx(right.twist * [1, -1, -1], abs=1e-5)


def test_a_centre_of_mass_to_the_left_loads_the_left():
    aside = BOT.model_copy(update={"centre_of_mass": (0.02, 0.05, 0.1)})
    rest = aside.loads(np.zeros((1, 2)))[0]
    x, y = aside.places.T
    assert rest.sum() == pytest.approx(aside.weight)
    assert rest @ x / rest.sum() == pytest.approx(0.02)
    assert rest @ y / rest.sum() == pytest.approx(0.05)
    # Turning left presses on the right wheels.
    turning = aside.loads(np.array([[0.0, 1.0]]))[0]
    assert turning[[1, 3]].sum() - rest[[1, 3]].sum() == pytest.approx(aside.mass * 1.0 * 0.1 / aside.track)


@pytest.mark.parametrize("modulus", [1e-4, 4e-4, 1.6e-3])
def test_the_quadrature_has_converged(modulus):
    motion = side_torques(BOT, ground(0.6, modulus), RADII, 0.4)
    rims = BOT.rims(np.stack([np.full_like(RADII, 0.4), 0.4 / RADII], -1))
    friction = np.full((len(RADII), 2), 0.6)
    coarse, fine = (
        floor_forces(BOT, friction, modulus, rims, motion.twist, nodes).wrench for nodes in ((16, 3), (64, 12))
    )
    assert np.abs(coarse - fine).max() < 1e-4 * 0.6 * BOT.weight


def test_shear_begins_at_zero_and_grows_by_the_sliding_speed():
    # A locked wheel has slid for ever; one that rolls freely on its way, and straight, not at all.
    free = floor_forces(BOT, np.full((1, 2), 0.6), 1e-3, np.full((1, 2), 0.4), np.array([[0.4, 0.0, 0.0]]))
    assert np.abs(free.wrench).max() < 1e-9
    # Small slip s: mean of j = s x over the patch against K, tau = p mu j / K.
    slip, modulus = 1e-4, 1e-2
    little = floor_forces(
        CENTRED, np.full((1, 2), 0.6), modulus, np.full((1, 2), 0.4), np.array([[0.4 * (1 - slip), 0.0, 0.0]])
    )
    assert little.wrench[0, 0] == pytest.approx(0.6 * BOT.weight * slip * BOT.patch_length / 2 / modulus, rel=1e-2)


def test_the_inner_side_turns_backward_below_half_the_track_and_drives_beyond_20_m_as_printed():
    radii = np.array([0.15, 0.19, 0.2, 0.3, 1.0, 10.0, 18.0, 25.0, 100.0])
    torques = side_torques(BOT, VINYL, radii, 0.2)
    assert (torques.inner_speed[:2] < 0).all() and (torques.inner_speed[2:] > 0).all()
    assert (torques.inner[:2] < 0).all(), "it slips backward: power is positive"
    assert (torques.inner[2:7] < 0).all(), "it skids and gives power back"
    assert (torques.inner[7:] > 0).all(), "it drives, too"
    assert (torques.outer > 0).all()


def test_no_least_radius_on_vinyl_and_one_on_asphalt():
    result = [
        least_radius(lambda r, on=on: side_torques(BOT, on, r, 0.4).outer, BOT.torque_limit) for on in (VINYL, ASPHALT)
    ]
    assert result[0] == 0.0
    # P4 prints 1.8 m; its friction and modulus give less in these equations, as packages/extras/docs/energy.md says.
    assert 0.3 < result[1] < ASPHALT.published_least_radius
    # With the modulus of vinyl it would be theirs.
    stiff = ASPHALT.model_copy(update={"shear": ASPHALT.shear.model_copy(update={"modulus": 0.0004})})
    assert least_radius(lambda r: side_torques(BOT, stiff, r, 0.4).outer, BOT.torque_limit) == pytest.approx(
        1.8, rel=0.2
    )


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: side_torques(BOT, load_terrain("grass"), 1.0, 0.4), "not known; give"),
        (lambda: side_torques(BOT, VINYL, 0.0, 0.4), "other than zero"),
        (lambda: load_terrain("vinil"), "did you mean 'vinyl'"),
    ],
)
def test_bad_input_gets_a_sentence(call, words):
    with one_line_error(ConfigError, words):
        call()
