"""A number that a step says of itself is declared once, and is there wherever a step is written down."""

import math
from dataclasses import fields

import numpy as np
import pytest

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.models.logs.drive_log.tick import decided_cells, tick_schema
from diffdrive_mpc.models.step_scalars import scalar_row, scalars_of, step_scalars
from diffdrive_mpc.mpc.step_result import StepResult


@pytest.fixture(scope="module")
def run():
    config = load_config("sm", {"online_dead_time.enabled": True})
    return simulate(Controller(config), make_plant("model:sm"), load_trajectory("s"))


def test_what_is_declared_is_an_attribute_of_a_step():
    known = {field.name for field in fields(StepResult)}
    assert {scalar.of.partition(".")[0] for scalar in step_scalars().values()} <= known


def test_a_run_keeps_what_its_steps_said(run):
    assert {"reference_progress", "blocked_for_s", "dead_time_omega_used_s"} <= set(run.columns)
    assert np.all(run.columns["reference_progress"][:-1] <= 1.0)
    # Nothing is looked for around this robot.
    assert "clearance_m" not in run.columns


def test_rows_of_logs_and_their_schema_hold_them():
    controller = Controller(load_config("sm"))
    plant = make_plant("model:sm")
    controller.start(load_trajectory("s"), 0.0)
    plant.reset((0.0, 0.0, 0.0))
    step = controller.step(0.0, plant.measure())
    assert scalars_of(step).items() <= decided_cells(step).items()
    assert {"reference_progress", "reference_delay_s", "blocked_for_s"} <= scalars_of(step).keys()
    assert step_scalars().keys() <= tick_schema()["properties"].keys()


def test_a_controller_that_says_nothing_has_none():
    assert all(math.isnan(value) for value in scalar_row(object()))
    assert scalars_of(object()) == {}
