"""Loop of plant, sensors and controller in C, compared bit for bit with the loop in Python."""

from dataclasses import fields

import numpy as np
import pytest

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant
from diffdrive_mpc.bench.drive import plant_settings
from diffdrive_mpc.mpc.core.library import load_core
from diffdrive_mpc.sim import Run, simulate
from diffdrive_mpc.sim.core.library import load_twin
from diffdrive_mpc.sim.plants.disturbed_plant import DisturbedPlant

OMITTED_FIELDS = {"measurements", "step_time", "solve_time", "reference"}
RARE_POSES = """
pose: {period: 0.05, latency: 0.13, loss: 0.3, position_sd: 0.01, turned: 0.2, stamped_on_arrival: true}
gyro: {scale: 1.1, bias_sd: 0.01}
encoders: {left: 0.98, swapped: false, speed_sd: 0.3}
"""


def drives(config, trajectory, plant, **arguments):
    """Return the run of the loop in Python, the lean run, and the number of ticks that the lean run made in Python."""
    parsed = load_config(config) if isinstance(config, str) else load_config(*config)
    reference, runs, ticks = load_trajectory(trajectory, parsed), [], 0
    for lean in (False, True):
        controller = Controller(parsed)
        complete, ticks = controller._complete, 0

        def count(*arguments, complete=complete, **keywords):
            nonlocal ticks
            ticks += 1
            return complete(*arguments, **keywords)

        controller._complete = count
        robot = make_plant(plant, seed=3, **plant_settings(parsed), **arguments)
        runs.append(simulate(controller, robot, reference, lean=lean))
    return *runs, ticks


def different_fields(run: Run, lean: Run) -> list[str]:
    """Return the names of the fields that differ in any bit."""

    def is_equal(name: str) -> bool:
        value, expected = getattr(lean, name), getattr(run, name)
        is_array = isinstance(value, np.ndarray)
        return np.array_equal(value, expected, equal_nan=True) if is_array else value == expected

    return [field.name for field in fields(Run) if field.name not in OMITTED_FIELDS and not is_equal(field.name)]


@pytest.mark.parametrize(
    ("config", "trajectory", "plant", "arguments"),
    [
        ("ssm", "circle", "model:ssm+0.04", {}),
        ("sm", "s", "model:sm", {"sensors": "slam"}),
        ("mbm", "square", "model:mbm+0.013", {"sensors": "poses_20hz", "surface": "slippery"}),
        ("ssm", "cane", "model:sm", {"sensors": "perfect"}),
        (("ssm", {"horizon": 12, "limits.omega": 0.55}), "circle", "model:ssm+0.1", {}),
        ("ssm", "circle", "model:ssm", {"sensors": "half_lost"}),
    ],
)
def test_ordinary_ticks_in_c_equal_those_in_python(config, trajectory, plant, arguments) -> None:
    run, lean, python_ticks = drives(config, trajectory, plant, **arguments)
    assert different_fields(run, lean) == []
    assert python_ticks < 0.05 * len(run.time)
    assert not lean.measurements and np.isnan(lean.step_time).all() and np.isnan(lean.solve_time).all()
    assert lean.metrics.completed


@pytest.mark.parametrize(
    ("config", "trajectory", "plant", "arguments", "text"),
    [
        ("ssm", "circle", "model:husky", {}, "wheels turn"),
        ("ssm", "circle", "model:ssm+0.25", {}, "wheels turn"),
        (("ssm", {"sample_time": 0.05}), "s", "model:ssm", {"sensors": "half_lost"}, "no pose has arrived yet"),
        (("ssm", {"reentry.band": 0.02}), "s", "model:ssm+0.06", {"surface": "ice"}, "rejoining"),
        (("ssm", {"reentry.enabled": False, "failure.max_position_error": 0.02}), "s", "model:sm+0.2", {}, "limit is"),
        ("sm", "cane", "model:two_delays", {"sensors": "RARE"}, "poses are about"),
    ],
)
def test_ticks_that_need_python_continue_the_loop_in_c(config, trajectory, plant, arguments, text, tmp_path) -> None:
    (tmp_path / "RARE").write_text(RARE_POSES)
    arguments |= {"sensors": tmp_path / "RARE"} if arguments.get("sensors") == "RARE" else {}
    run, lean, python_ticks = drives(config, trajectory, plant, **arguments)
    assert different_fields(run, lean) == []
    assert 1 <= python_ticks < len(run.time) - 2
    assert any(text in message for message in run.messages), set(run.messages)


def test_backend_solves_each_tick_in_python() -> None:
    run, lean, python_ticks = drives(("ssm", {"solver.method": "osqp", "horizon": 10}), "cane", "model:ssm")
    assert different_fields(run, lean) == []
    assert python_ticks == len(run.time) and set(run.solver_methods) == {"osqp"}


@pytest.mark.parametrize("plant", ["model:ssm", "mujoco"])
def test_plants_without_a_loop_in_c_are_driven_in_python(plant) -> None:
    arguments = {"scenario": "sensor_dropouts"} if plant == "model:ssm" else {}
    run, lean, python_ticks = drives("ssm", "cane", plant, **arguments)
    assert different_fields(run, lean) == [] and python_ticks == len(run.time)
    assert isinstance(make_plant("model:ssm", scenario="sensor_dropouts"), DisturbedPlant)


def test_readings_have_the_layout_of_the_core() -> None:
    def layout(ffi, name):
        return [(field, entry.offset, entry.type.cname) for field, entry in ffi.typeof(name).fields]

    assert layout(load_twin()[0], "sensor_reading") == layout(load_core()[0], "ddmpc_stamped")
    core = load_core()[1]
    assert core.DDMPC_TRACKING == core.DDMPC_QP_SOLVED == core.DDMPC_DONE == 0
