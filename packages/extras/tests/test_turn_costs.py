"""Turn costs: identification of the slip law, torques, numeric and symbolic power, minimum radius, and files."""

import casadi as ca
import numpy as np
import pytest
import yaml

from diffdrive_mpc import ConfigError
from diffdrive_mpc.models.slip_laws import polynomial_twist
from diffdrive_mpc_extras.terrain import load_terrain
from diffdrive_mpc_extras.torque import TorqueCurves
from diffdrive_mpc_extras.torque.torque_curves import costs_of_curves, predict_energy
from diffdrive_mpc_extras.turn_costs import (
    identify_slip,
    load_drive_constants,
    load_turn_costs,
    load_vehicle,
    turn_costs_text,
)
from refusals import one_line_error

BOT, MOTORS = load_vehicle("fsu_bot"), load_drive_constants("fsu_bot")
TRUE_SLIP = np.array(load_terrain("asphalt").slip)
SURFACES = ("slippery", "default", "carpet", "grippy")
GRID = np.array([[v, w] for v in (-0.6, -0.2, 0.0, 0.2, 0.4, 0.6) for w in np.linspace(-1.2, 1.2, 41)])


@pytest.fixture(scope="module")
def curves():
    return TorqueCurves.from_prior(BOT, load_terrain("vinyl"))


@pytest.fixture(scope="module")
def vinyl(curves):
    return costs_of_curves(curves, TRUE_SLIP, name="vinyl", vehicle=BOT, drive=MOTORS, provenance="prior")


def drive_commands(rng, count=40, hold=25):
    v, radius = rng.uniform(0.2, 0.6, count), rng.uniform(0.8, 20.0, count) * rng.choice([-1, 1], count)
    return np.repeat(np.stack([v, v / radius], -1), hold, axis=0)


def test_slip_law_is_identified_within_its_standard_deviations():
    rng = np.random.default_rng(3)
    commands = drive_commands(rng)
    clean = identify_slip(commands, polynomial_twist(TRUE_SLIP, commands))
    assert clean.coefficients == pytest.approx(TRUE_SLIP, abs=1e-9)
    normalised_errors = []
    for _ in range(60):
        noisy = polynomial_twist(TRUE_SLIP, commands) + rng.normal(0, [0.01, 0.01, 0.03], (len(commands), 3))
        estimate = identify_slip(commands, noisy)
        normalised_errors.append((estimate.coefficients - TRUE_SLIP) / estimate.deviations)
    assert np.std(normalised_errors) == pytest.approx(1.0, abs=0.15)


def test_settling_and_non_finite_samples_are_omitted():
    commands = drive_commands(np.random.default_rng(6))
    twist = polynomial_twist(TRUE_SLIP, commands)
    twist[::25] += 1.0  # the first row after each change
    twist[7] = np.nan
    assert identify_slip(commands, twist, 0.02, 0.02).coefficients == pytest.approx(TRUE_SLIP, abs=1e-9)
    assert np.abs(identify_slip(commands, twist).coefficients - TRUE_SLIP).max() > 1e-3


@pytest.mark.parametrize(
    ("commands", "twist", "message"),
    [
        (np.ones((50, 3)), np.ones((50, 3)), "use (n, 2) and (n, 3)"),
        (np.tile([0.4, 0.1], (50, 1)), np.ones((50, 3)), "turns to both sides at two speeds"),
        (np.tile([0.4, 0.0], (50, 1)), np.ones((50, 3)), "turns to both sides at two speeds"),
    ],
)
def test_drive_without_sufficient_excitation_is_refused(commands, twist, message):
    with one_line_error(ConfigError, message):
        identify_slip(commands, twist)


def test_table_agrees_with_its_torque_curves(vinyl, curves):
    forward = GRID[(GRID[:, 0] > 0) & (np.abs(GRID[:, 1]) < 2 * GRID[:, 0])]
    assert vinyl.torques(forward) == pytest.approx(curves.torques(forward), abs=0.06)
    commands = drive_commands(np.random.default_rng(7))
    energy = vinyl.power(commands).sum() * 0.02
    assert energy == pytest.approx(predict_energy(BOT, MOTORS, curves, commands, 0.02).energy, rel=0.01)


@pytest.mark.parametrize("name", SURFACES)
def test_torques_have_the_symmetries_of_the_robot(name):
    costs = load_turn_costs(f"fsu_bot-{name}")
    torques = costs.torques(GRID)
    assert costs.torques(GRID * [1, -1]) == pytest.approx(torques[:, ::-1], abs=1e-12)  # mirrored
    assert costs.torques(-GRID) == pytest.approx(-torques, abs=1e-12)  # backward
    assert np.abs(torques).max() <= costs.vehicle.torque_limit
    assert costs.torques([[0.0, 0.0]]) == pytest.approx(np.zeros((1, 2)), abs=1e-12)
    spot_turn = costs.torques([[0.0, 0.5]])
    assert spot_turn[0, 0] == pytest.approx(-spot_turn[0, 1])


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("symbol", [ca.SX.sym, ca.MX.sym])
def test_symbolic_power_is_smooth_and_agrees_with_the_numeric_power(name, symbol):
    costs = load_turn_costs(f"fsu_bot-{name}")
    v, omega = symbol("v"), symbol("w")
    power = costs.symbolic_power(v, omega)
    command = ca.vertcat(v, omega)
    function = ca.Function("power", [v, omega], [power, ca.gradient(power, command), ca.hessian(power, command)[0]])
    rows = GRID[GRID[:, 0] > 0]
    values = np.array([float(function(*row)[0]) for row in rows])
    expected = costs.power(rows)
    assert np.abs(values - expected).max() < 0.03 * expected.max() + 0.1
    # The power is even in the yaw rate: its slope is zero on a straight path.
    value, gradient, hessian = (np.array(output) for output in function(0.4, 0.0))
    assert gradient[1] == pytest.approx(0.0, abs=1e-9)
    neighbour = float(function(0.4, 1e-5)[0])
    assert (neighbour - float(value.squeeze())) * 2e10 == pytest.approx(hessian[1, 1], rel=0.05)
    assert all(np.isfinite(np.array(output)).all() for row in GRID for output in function(*row))


def test_braking_side_returns_no_power_without_regeneration():
    costs = load_turn_costs("fsu_bot-grippy")
    no_regeneration = costs.model_copy(update={"drive": MOTORS.model_copy(update={"regeneration": False})})
    turn = [[0.4, 0.1]]
    rim_speed = no_regeneration.vehicle.rim_speeds(np.array(turn))[0, 0]
    inner_power = no_regeneration.torques(turn)[0, 0] * rim_speed / no_regeneration.vehicle.wheel_radius
    assert inner_power < 0 and no_regeneration.power(turn) > costs.power(turn)
    v, omega = ca.SX.sym("v"), ca.SX.sym("w")
    function = ca.Function("power", [v, omega], [no_regeneration.symbolic_power(v, omega)])
    assert float(function(0.4, 0.1)) == pytest.approx(no_regeneration.power(turn)[0], rel=0.02)


def test_least_radius_reaches_the_torque_limit_and_is_proportional_to_speed():
    assert load_turn_costs("fsu_bot-slippery").least_radius() == 0.0
    grippy = load_turn_costs("fsu_bot-grippy")
    assert 1.5 < grippy.least_radius() < 2.5
    assert grippy.least_radius(0.6) == pytest.approx(1.5 * grippy.least_radius(0.4), rel=0.01)
    outer = grippy.torques([[0.4, 0.4 / grippy.least_radius()]])[0, 1]
    assert outer == pytest.approx(0.95 * BOT.torque_limit, rel=1e-3)
    with pytest.raises(ConfigError, match=r"speed 0 m/s"):
        grippy.least_radius(0)


def test_written_turn_costs_can_be_loaded(vinyl, tmp_path):
    path = tmp_path / "costs.yaml"
    path.write_text(turn_costs_text(vinyl), encoding="utf-8")
    loaded = load_turn_costs(path)
    assert "vehicle: fsu_bot" in path.read_text(encoding="utf-8")
    assert loaded.power(GRID) == pytest.approx(vinyl.power(GRID), abs=0.01)
    heavier = vinyl.model_copy(update={"vehicle": BOT.model_copy(update={"weight": BOT.weight + 5.0 * 9.81})})
    path.write_text(turn_costs_text(heavier), encoding="utf-8")
    assert load_turn_costs(path).vehicle == heavier.vehicle


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"curve": {"radius": [1, 2, 2], "outer": [1, 1, 1], "inner": [0, 0, 0]}}, "must ascend"),
        ({"vehicle": "fsu_bott"}, "did you mean 'fsu_bot'"),
    ],
)
def test_invalid_file_raises_config_error(tmp_path, change, message):
    content = yaml.safe_load(turn_costs_text(load_turn_costs("fsu_bot-carpet")))
    for key, value in change.items():
        content[key] = content[key] | value if isinstance(value, dict) else value
    path = tmp_path / "costs.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    with one_line_error(ConfigError, message):
        load_turn_costs(path)
