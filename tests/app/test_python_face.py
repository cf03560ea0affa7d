"""Python interface: names in place of objects, and sweeps."""

import warnings
from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest

import diffdrive_mpc
from diffdrive_mpc import (
    Controller,
    Trajectory,
    VelocityModel,
    load_config,
    load_model,
    load_trajectory,
    make_plant,
    simulate,
    sweep,
)

STRAIGHT = Trajectory.from_waypoints([(0, 0), (0.3, 0)], name="straight")
PLANT = "model:ssm"
SYSTEM = control.tf([1.0], [0.1, 1.0])


@pytest.fixture(scope="module")
def controller():
    return Controller("ssm")


def test_names_are_accepted_in_place_of_objects(controller):
    config = load_config("ssm")
    plant = make_plant(PLANT, sample_time=config.sample_time)
    expected = simulate(Controller(config), plant, load_trajectory("circle", config))
    # The second run with the same controller starts from rest, too.
    for part in ("ssm", controller, controller):
        run = simulate(part, PLANT, "circle")
        np.testing.assert_array_equal(run.true_pose, expected.true_pose)
        np.testing.assert_array_equal(run.command, expected.command)
    controller.start("circle", 0.0)
    assert controller.reference.name == "circle"


def test_plant_by_name_has_the_sample_time_of_the_controller_and_may_be_a_model():
    model = VelocityModel.from_control((SYSTEM, SYSTEM), name="mine")
    run = simulate({"model": "ssm", "sample_time": 0.05}, model, STRAIGHT)
    assert run.sample_time == 0.05
    assert run.metrics.completed


@pytest.mark.parametrize(
    "config",
    ["ssm", load_config("ssm"), {"model": "ssm"}, Path(diffdrive_mpc.mpc.__path__[0]) / "config/parameters/ssm.yaml"],
)
def test_controller_accepts_the_arguments_of_load_config(config):
    assert Controller(config).config.model == "ssm"


def test_keywords_replace_values_of_the_configuration():
    config = Controller("ssm", horizon=20, **{"weights.across": 200.0}).config
    assert (config.horizon, config.weights.across) == (20, 200.0)


def test_start_at_speed_gives_a_warning_and_a_start_from_rest_gives_none(controller):
    t = np.linspace(0.0, 0.5, 30)
    with pytest.warns(UserWarning, match="reference 'arrays': infeasible from 0.13 s .* it falls 0.16 m behind"):
        simulate(controller, PLANT, Trajectory.from_arrays(t, 0.85 * t, 0 * t))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulate(controller, PLANT, STRAIGHT)


def test_sweep_returns_a_table_with_one_row_per_run():
    shipped = load_model("sm")
    converted = VelocityModel.from_control(shipped.to_control(), shipped.dead_time, name="mine")
    # Use the provenance of the same robot, because the yaw ratio of a model built in Python is less certain.
    mine = replace(converted, provenance=shipped.provenance)
    values = {"horizon": [10, 30], "weights.across": 150.0}
    table = sweep(model=["sm", mine], trajectory=STRAIGHT, seeds=range(2), plant=PLANT, jobs=1, **values)
    assert list(table.columns[:6]) == ["model", "trajectory", "seed", "plant", "horizon", "weights.across"]
    assert list(table["model"]) == ["sm"] * 4 + ["mine"] * 4
    assert list(table["seed"]) == [0, 0, 1, 1] * 2
    assert list(table["horizon"]) == [10, 30] * 4
    assert table["completed"].all()
    assert set(table["ended"]) == {""}
    # The values equal those of a single run, and the same model has equal values under both names.
    run = simulate(load_config("sm", {"horizon": 30, "weights.across": 150.0}), make_plant(PLANT, seed=1), STRAIGHT)
    assert table["position_rmse_m"][3] == run.metrics.position_rmse_m
    np.testing.assert_allclose(table["position_rmse_m"][:4], table["position_rmse_m"][4:], rtol=1e-9)
    assert table.pivot_table("position_rmse_m", "horizon", "model").shape == (2, 2)
    assert (table["step_time_p50_s"] > 0).all()
