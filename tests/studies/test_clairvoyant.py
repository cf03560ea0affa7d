"""The bound is one: it tracks its own model to nearly nothing, and nobody tracks better on the physics."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_mpc import Measurement, load_config, load_trajectory
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import make_controller
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.sim import make_plant, simulate
from studies.tracking.clairvoyant import ClairvoyantController, load_clairvoyant_settings
from studies.tracking.known_plant import know_plant
from studies.tracking.measured import steady_arc_lateral


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Straight on, a stop, a curve: half as long as the cane."""
    path = tmp_path_factory.mktemp("trajectory") / "short.yaml"
    path.write_text(
        "segments:\n- {v: 0.5, omega: 0.0, duration: 1.5}\n- {v: 0.5, omega: 0.7, duration: 3.0}\n", encoding="utf-8"
    )
    return str(path)


def drive(plant, surface, trajectory, sensors="perfect", horizon=30, weights=None):
    settings = load_clairvoyant_settings().model_copy(update={"horizon": horizon})
    known = know_plant(plant, surface, (trajectory,))
    controller = ClairvoyantController(known, load_config("ssm", weights), settings)
    return simulate(controller, make_plant(plant, surface, sensors), load_trajectory(trajectory))


CHEAP = {"weights.v": 0.0, "weights.omega": 0.0, "weights.v_increment": 1e-3, "weights.omega_increment": 1e-3}


@pytest.mark.parametrize("plant", ["model:ssm", "model:sm"])
def test_on_the_plant_of_its_own_model_nothing_is_left_where_commands_cost_nothing(plant, short):
    """Slip included, which it knows. But no robot with a dead time is on a reference that sets off at once."""
    run = drive(plant, "default", short, weights=CHEAP)
    assert run.metrics.completed
    later = run.counted & (run.time > 1.0)
    assert run.errors.position[later].max() < 1e-3
    assert np.abs(run.errors.lateral).max() < 1e-3


def test_with_the_shipped_weights_steady_arcs_are_exact(short):
    run = drive("model:sm", "default", short)
    assert np.abs(steady_arc_lateral(run)).max() < 2e-4
    assert run.metrics.lateral_rmse_m < 1e-3


@pytest.mark.long
def test_it_holds_the_heading_error_that_side_slip_asks_for():
    run = drive("model:ssm", "slippery", "circle")
    known = know_plant("model:ssm", "slippery", ("circle",))
    steady = (run.time > 4) & (run.time < 11)
    assert run.errors.heading[steady] == pytest.approx(np.full(steady.sum(), 0.5 * known.side_slip), abs=3e-3)
    assert np.abs(run.errors.course[steady]).max() < 3e-3


@pytest.mark.long
def test_on_the_physics_it_is_better_than_ours():
    bound = drive("mujoco", "slippery", "cane")
    ours = simulate(make_controller(Case()), make_plant("mujoco", "slippery", "perfect"), load_trajectory("cane"))
    assert bound.metrics.completed
    assert bound.metrics.position_rmse_m <= ours.metrics.position_rmse_m
    assert bound.metrics.lateral_rmse_m <= ours.metrics.lateral_rmse_m


@pytest.mark.long
def test_it_keeps_the_hard_limits_of_the_command():
    config = load_config("ssm")
    run = drive("model:ssm", "default", "square", horizon=12)
    limits, dt = config.limits, run.sample_time
    steps = np.diff(np.vstack([np.zeros((1, 2)), run.command]), axis=0)
    assert (np.abs(run.command) <= np.array([limits.v, limits.omega]) + 1e-9).all()
    assert (np.abs(steps) <= dt * np.array([limits.v_slew, limits.omega_slew]) + 1e-9).all()


@pytest.mark.long
def test_the_same_run_again_is_the_same_bit_for_bit(short):
    first, second = (drive("model:ssm", "default", short, horizon=12).command for _ in range(2))
    assert np.array_equal(first, second)


def test_what_it_knows_of_the_physics_is_the_physics():
    """The plant's dead time is in the fit; a skid-steer slips outward in turns, more on a slippery floor."""
    default, slippery = (know_plant("mujoco", surface, ("cane",)) for surface in ("default", "slippery"))
    assert 0.03 < default.model.dead_time[0] < 0.06
    assert default.model.dc_gain[0, 0] == pytest.approx(1.0, abs=0.02)
    assert 0 < default.side_slip < slippery.side_slip
    assert default.load_shift > 0


def test_a_plant_that_is_a_model_is_known_exactly():
    known = know_plant("model:ssm", "slippery", ("cane",))
    plant = make_plant("model:ssm", "slippery", "perfect")
    for _ in range(200):
        plant.advance([0.5, 0.4])
    assert known.model.dc_gain @ [0.5, 0.4] == pytest.approx(plant.true_twist[[0, 2]], rel=1e-6)
    v, lateral, omega = plant.true_twist
    assert lateral == pytest.approx(-known.side_slip * v * omega, rel=1e-9)


def test_it_refuses_sensors_that_are_not_perfect():
    with pytest.raises(ValueError, match="use --sensors perfect"):
        drive("model:ssm", "default", "cane", sensors="default")


def test_it_has_to_be_started():
    controller = ClairvoyantController(know_plant("model:ssm", "ideal", ("cane",)), load_config("ssm"))
    with pytest.raises(RuntimeError, match="call start"):
        controller.step(0.0, Measurement())


def test_it_is_no_controller_to_choose():
    assert "clairvoyant" not in PEERS
