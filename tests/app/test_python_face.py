"""From Python as people of the field write it: names where objects stand, sweeps, and one sentence for each mistake."""

import warnings
from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest

import diffdrive_mpc
from diffdrive_mpc import (
    ArgumentError,
    ConfigError,
    Controller,
    Measurement,
    Stamped,
    Trajectory,
    VelocityModel,
    identify,
    integrate_pose,
    load_config,
    load_model,
    load_trajectory,
    make_plant,
    simulate,
    sweep,
)
from refusals import one_line_error

STRAIGHT = Trajectory.from_waypoints([(0, 0), (0.3, 0)], name="straight")
PLANT = "model:ssm"
SYSTEM = control.tf([1.0], [0.1, 1.0])


@pytest.fixture(scope="module")
def controller():
    return Controller("ssm")


def test_names_stand_for_what_they_name(controller):
    config = load_config("ssm")
    plant = make_plant(PLANT, sample_time=config.sample_time)
    expected = simulate(Controller(config), plant, load_trajectory("circle", config))
    named = simulate("ssm", PLANT, "circle")
    np.testing.assert_array_equal(named.true_pose, expected.true_pose)
    np.testing.assert_array_equal(named.command, expected.command)
    controller.start("circle", 0.0)
    assert controller.reference.name == "circle"


def test_a_plant_by_name_has_the_controllers_sample_time_and_a_model_is_one():
    mine = VelocityModel.from_control((SYSTEM, SYSTEM), name="mine")
    run = simulate({"model": "ssm", "sample_time": 0.05}, mine, STRAIGHT)
    assert run.sample_time == 0.05
    assert run.metrics.completed


@pytest.mark.parametrize(
    "config",
    ["ssm", load_config("ssm"), {"model": "ssm"}, Path(diffdrive_mpc.mpc.__path__[0]) / "config/parameters/ssm.yaml"],
)
def test_a_controller_takes_what_load_config_takes(config):
    assert Controller(config).config.model == "ssm"


def test_keywords_replace_values_of_the_configuration():
    config = Controller("ssm", horizon=20, **{"weights.across": 200.0}).config
    assert (config.horizon, config.weights.across) == (20, 200.0)
    with pytest.raises(ConfigError, match="unknown key 'horizn'; did you mean 'horizon'"):
        Controller("ssm", horizn=20)


def test_a_start_at_speed_is_told_and_one_from_rest_is_not(controller):
    t = np.linspace(0.0, 0.5, 30)
    with pytest.warns(UserWarning, match="reference 'arrays': infeasible from 0.13 s .* it falls 0.16 m behind"):
        simulate(controller, PLANT, Trajectory.from_arrays(t, 0.85 * t, 0 * t))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulate(controller, PLANT, STRAIGHT)


MISTAKES = {
    "array as trajectory": (lambda c: load_trajectory(np.zeros((5, 2))), "Trajectory.from_arrays(t, x, y)"),
    "model as configuration": (lambda c: Controller(load_model("ssm")), "Controller('ssm', model=model)"),
    "system as model": (lambda c: Controller("ssm", model=SYSTEM), "VelocityModel.from_control(system"),
    "pose as measurement": (lambda c: c.step(0.0, Stamped((0, 0, 0), 0.0)), "without news Measurement()"),
    "swapped step": (lambda c: c.step(Measurement(), 0.0), "call step(t, Measurement(...))"),
    "plant first": (lambda c: simulate(make_plant(PLANT), c, STRAIGHT), "simulate(controller, plant, reference)"),
    "array in simulate": (lambda c: simulate(c, PLANT, np.zeros((4, 2))), "got numpy.ndarray of shape (4, 2)"),
    "time as text": (lambda c: c.step("0", Measurement()), "call step(t, Measurement(...))"),
    "table as logs": (lambda c: identify(np.zeros((9, 3))), "make a pandas.DataFrame of arrays"),
    "limits as number": (lambda c: c.update(limits=1.0), "write update(limits={'v': 1.0})"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_type_is_one_sentence_that_says_how_to_make_it(controller, mistake):
    make, remedy = MISTAKES[mistake]
    controller.start(STRAIGHT, 0.0)
    assert issubclass(ArgumentError, TypeError)
    with one_line_error(ArgumentError, remedy, "expected ", "got "):
        make(controller)


UNUSABLE = {
    "misspelt method": (lambda: Controller("ssm", **{"solver.method": "OSQP"}), "found 'OSQP'); did you mean 'osqp'?"),
    "text as group": (lambda: Controller("ssm", solver="osqp"), "solver: expected keys and values (found 'osqp')"),
    "horizon 0": (
        lambda: Controller("ssm", horizon=0),
        "horizon: Input should be greater than or equal to 1 (found 0)",
    ),
    "negative weight": (
        lambda: load_config("ssm", {"weights.across": -1.0}),
        "weights.across: Input should be greater",
    ),
    "track in mm": (lambda: load_config("ssm", {"wheels.track": 400.0}), "wheels.track: Input should be less"),
    "missing configuration": (lambda: load_config("mine.yaml"), "'mine.yaml': there is no such file; give one of"),
    "missing trajectory": (lambda: load_trajectory("my/path.csv"), "'my/path.csv': there is no such file; give one of"),
    "misspelt model": (lambda: load_model("smm"), "did you mean 'sm'?"),
    "NaN in trajectory": (lambda: Trajectory.from_arrays([0, 1], [0, np.nan], [0, 0]), "x[1] is not a finite number"),
    "lengths": (lambda: Trajectory.from_arrays([0, 1], [0], [0, 0]), "x has 1 values, t has 2; give one for each"),
    "misspelt structure": (lambda: identify("drive.csv", structure="ssmm"), "structure 'ssmm': give one of"),
    "missing log": (lambda: identify("mising.csv"), "mising.csv: there is no such file or folder"),
    "misspelt surface": (lambda: make_plant("mujoco", "icy"), "did you mean 'ice'?"),
    "short pose": (lambda: integrate_pose([0.0, 0.0], 1.0, 0.0, 0.1), "give x, y and theta in the last axis"),
    "misspelt dimension": (lambda: sweep(trajectories="s"), "'trajectories'; did you mean 'trajectory'?"),
}


@pytest.mark.parametrize("mistake", UNUSABLE)
def test_an_unusable_value_is_one_sentence_with_place_and_remedy(mistake):
    make, message = UNUSABLE[mistake]
    with one_line_error(ValueError, message):
        make()


def test_a_misspelt_public_name_gets_a_suggestion():
    with pytest.raises(AttributeError, match="did you mean 'Controller'"):
        _ = diffdrive_mpc.Controler


def test_a_sweep_is_a_table_with_one_row_for_each_run():
    shipped = load_model("sm")
    made = VelocityModel.from_control(shipped.to_control(), shipped.dead_time, name="mine")
    # Of the same robot: the ratio of yaw rates of a model made in Python is less certain.
    mine = replace(made, provenance=shipped.provenance)
    values = {"horizon": [10, 30], "weights.across": 150.0}
    table = sweep(model=["sm", mine], trajectory=STRAIGHT, seeds=range(2), plant=PLANT, jobs=1, **values)
    assert list(table.columns[:6]) == ["model", "trajectory", "seed", "plant", "horizon", "weights.across"]
    assert list(table["model"]) == ["sm"] * 4 + ["mine"] * 4
    assert list(table["seed"]) == [0, 0, 1, 1] * 2
    assert list(table["horizon"]) == [10, 30] * 4
    assert table["completed"].all()
    assert set(table["ended"]) == {""}
    # The same numbers as the run by itself, and the same model under both names.
    run = simulate(load_config("sm", {"horizon": 30, "weights.across": 150.0}), make_plant(PLANT, seed=1), STRAIGHT)
    assert table["position_rmse_m"][3] == run.metrics.position_rmse_m
    np.testing.assert_allclose(table["position_rmse_m"][:4], table["position_rmse_m"][4:], rtol=1e-9)
    assert table.pivot_table("position_rmse_m", "horizon", "model").shape == (2, 2)
    assert (table["step_time_p50_s"] > 0).all()


@pytest.mark.parametrize(
    ("values", "message"),
    [({"horizn": 3}, "unknown key 'horizn'; did you mean 'horizon'"), ({"seeds": 0}, "seeds = 0; give 1 to 10000")],
)
def test_a_sweep_that_cannot_run_is_refused_before_it_begins(values, message):
    with pytest.raises(ConfigError, match=message):
        sweep(plant=PLANT, **values)
