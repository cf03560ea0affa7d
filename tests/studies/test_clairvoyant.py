"""Clairvoyant bound: nearly zero error on its model, and lower error than all controllers on mujoco."""

import numpy as np
import pytest

from diffdrive_mpc import load_config, load_trajectory
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import make_controller
from diffdrive_mpc.sim import make_plant, simulate
from studies.tracking.clairvoyant import ClairvoyantController, load_clairvoyant_settings
from studies.tracking.known_plant import identify_plant

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def short_path(tmp_path_factory):
    """Path with a straight line, a stop and a curve, half as long as the cane."""
    path = tmp_path_factory.mktemp("trajectory") / "short.yaml"
    path.write_text(
        "segments:\n- {v: 0.5, omega: 0.0, duration: 1.5}\n- {v: 0.5, omega: 0.7, duration: 3.0}\n", encoding="utf-8"
    )
    return str(path)


def drive(plant, surface, trajectory, sensors="perfect", horizon=30, weights=None):
    settings = load_clairvoyant_settings().model_copy(update={"horizon": horizon})
    plant_model = identify_plant(plant, surface, (trajectory,))
    controller = ClairvoyantController(plant_model, load_config("ssm", weights), settings)
    return simulate(controller, make_plant(plant, surface, sensors), load_trajectory(trajectory))


LOW_WEIGHTS = {"weights.v": 0.0, "weights.omega": 0.0, "weights.v_increment": 1e-3, "weights.omega_increment": 1e-3}


@pytest.mark.parametrize("plant", ["model:ssm", "model:sm"])
def test_bound_tracks_its_own_model_without_error_if_commands_are_free(plant, short_path):
    """The slip is known. A dead time prevents an immediate start, so errors are evaluated after the first second."""
    run = drive(plant, "default", short_path, weights=LOW_WEIGHTS)
    assert run.metrics.completed
    is_settled = run.counted & (run.time > 1.0)
    assert run.errors.position[is_settled].max() < 1e-3
    assert np.abs(run.errors.lateral).max() < 1e-3


@pytest.mark.long
def test_bound_is_better_than_the_mpc_on_mujoco():
    bound = drive("mujoco", "slippery", "cane")
    mpc = simulate(make_controller(Case()), make_plant("mujoco", "slippery", "perfect"), load_trajectory("cane"))
    assert bound.metrics.completed
    assert bound.metrics.position_rmse_m <= mpc.metrics.position_rmse_m
    assert bound.metrics.lateral_rmse_m <= mpc.metrics.lateral_rmse_m


def test_prediction_of_a_model_plant_is_exact():
    plant_model = identify_plant("model:ssm", "slippery", ("cane",))
    plant = make_plant("model:ssm", "slippery", "perfect")
    for _ in range(200):
        plant.advance([0.5, 0.4])
    assert plant_model.model.dc_gain @ [0.5, 0.4] == pytest.approx(plant.true_twist[[0, 2]], rel=1e-6)
    v, lateral, omega = plant.true_twist
    assert lateral == pytest.approx(-plant_model.side_slip * v * omega, rel=1e-9)
