"""From Python as people of the field write it: names where objects stand, sweeps, and one sentence for each mistake."""

import re
import sys
import warnings
from pathlib import Path

import casadi as ca
import control
import numpy as np
import pytest

import diffdrive_mpc
from diffdrive_mpc import (
    ArgumentError,
    ConfigError,
    Controller,
    Measurement,
    MissingPackageError,
    Stamped,
    Term,
    Trajectory,
    VelocityModel,
    identify,
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
POSE = ca.SX.sym("pose", 3)
TERM = Term("x", ca.Function("x", [POSE], [POSE[0]], ["pose"], ["value"]))


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


def test_a_start_at_speed_is_told_and_one_from_rest_is_not(controller):
    t = np.linspace(0.0, 0.5, 30)
    with pytest.warns(UserWarning, match="reference 'arrays' starts at 0.85 m/s and 0 rad/s, the robot at rest: "):
        simulate(controller, PLANT, Trajectory.from_arrays(t, 0.85 * t, 0 * t))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulate(controller, PLANT, STRAIGHT)


MISTAKES = {
    "array as trajectory": (lambda c: load_trajectory(np.zeros((5, 2))), "Trajectory.from_arrays(t, x, y)"),
    "model as configuration": (lambda c: Controller(load_model("ssm")), "Controller('ssm', model=model)"),
    "no configuration": (lambda c: load_config(None), "keys and values"),
    "system as model": (lambda c: Controller("ssm", model=SYSTEM), "VelocityModel.from_control(system"),
    "one term": (lambda c: Controller("ssm", terms=TERM), "terms=[term]"),
    "pose without a time": (lambda c: Measurement(pose=(0, 0, 0)), "write pose=Stamped(value, time in s)"),
    "pose as measurement": (lambda c: c.step(0.0, Stamped((0, 0, 0), 0.0)), "without news Measurement()"),
    "swapped step": (lambda c: c.step(Measurement(), 0.0), "call step(t, Measurement(...))"),
    "plant first": (lambda c: simulate(make_plant(PLANT), c, STRAIGHT), "simulate(controller, plant, reference)"),
    "class": (lambda c: simulate(Controller, PLANT, STRAIGHT), "got the class Controller itself"),
    "array in simulate": (lambda c: simulate(c, PLANT, np.zeros((4, 2))), "got numpy.ndarray of shape (4, 2)"),
    "plant of a number": (lambda c: make_plant(3), "make_plant('mujoco')"),
    "time as text": (lambda c: c.start(STRAIGHT, "now"), "give seconds on the clock of step"),
    "limits as number": (lambda c: c.update(limits=1.0), "write update(limits={'v': 1.0})"),
    "logs as array": (lambda c: identify(np.zeros((5, 3))), "paths of log files"),
    "model of a sweep": (lambda c: sweep(model=3), "sweep: model: expected a name, a path or a model, got int 3"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_type_is_one_sentence_that_says_how_to_make_it(controller, mistake):
    make, remedy = MISTAKES[mistake]
    controller.start(STRAIGHT, 0.0)
    with pytest.raises(ArgumentError, match=re.escape(remedy)) as caught:
        make(controller)
    message = str(caught.value)
    assert "expected " in message
    assert "got " in message
    assert "\n" not in message
    assert isinstance(caught.value, TypeError)


@pytest.mark.parametrize(
    ("load", "name"), [(make_plant, "mujco"), (make_plant, "ssm"), (load_model, "SSM"), (load_trajectory, "Circle")]
)
def test_a_name_that_is_nearly_one_is_suggested(load, name):
    near = {"mujco": "mujoco", "ssm": "model:ssm"}.get(name, name.lower())
    with pytest.raises(ConfigError, match=f"did you mean '{near}'"):
        load(name)


def test_a_sweep_is_a_table_with_one_row_for_each_run():
    mine = VelocityModel.from_control(load_model("sm").to_control(), load_model("sm").dead_time, name="mine")
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
    [
        ({"horizn": 3}, "unknown key 'horizn'; did you mean 'horizon'"),
        ({"horizon": 500}, "horizon: Input should be less than or equal to 200"),
        ({"horizon": []}, "horizon has no value; give one or several"),
        ({"weights": {"across": 3.0}}, "groups have dotted keys, such as 'weights.across'"),
        ({"model": "sss"}, "did you mean 'ssm'"),
        ({"seeds": 0}, "seeds = 0; give 1 to 10000"),
        ({"seeds": [-1]}, "give whole numbers from 0 on"),
        ({"seeds": "a"}, "seeds 'a'; give whole numbers from 0 on"),
        ({"seeds": 1.5}, "seeds 1.5; give whole numbers from 0 on"),
    ],
)
def test_a_sweep_that_cannot_run_is_refused_before_it_begins(values, message):
    with pytest.raises(ConfigError, match=message):
        sweep(plant=PLANT, **values)


def test_without_pandas_a_sweep_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingPackageError, match=r"^sweep needs pandas: pip install pandas$"):
        sweep(plant=PLANT)


def test_what_is_printed_says_what_it_is(controller):
    controller.start(STRAIGHT, 0.0)
    shown = {
        repr(controller): "Controller with model 'SSM', 30 steps of 0.0202 s ahead, tracking 'straight'",
        repr(make_plant(PLANT)): "ModelPlant of 'SSM', samples of 0.0202 s",
        repr(make_plant("mujoco")): "MujocoPlant, friction 0.8, samples of 0.0202 s",
        repr(
            make_plant(PLANT, scenario="sensor_dropouts")
        ): "DisturbedPlant around ModelPlant of 'SSM', samples of 0.0202 s",
        repr(load_trajectory("circle")): "Trajectory 'circle': 13.07 s, 6.283 m",
    }
    for text, expected in shown.items():
        assert text == expected


@pytest.mark.parametrize("module", [diffdrive_mpc, diffdrive_mpc.models, diffdrive_mpc.mpc, diffdrive_mpc.sim])
def test_only_public_names_are_listed(module):
    assert dir(module) == sorted(module.__all__)
