"""Other robots of the bench, the split of errors, and the gate that compares a bench with the last result."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pandas import DataFrame

from diffdrive_mpc.bench.comparison.other_robots import PATHS, dynamics_cases, other_robots
from diffdrive_mpc.bench.comparison.tables import error_part
from diffdrive_mpc.bench.controllers import run_case


def drive(robot, trajectory, driver, seed):
    cases = {replace(case, trajectory=trajectory) for case in dynamics_cases((seed,)) if case.plant.endswith(robot)}
    (case,) = (case for case in cases if driver in (case.labels["model"], case.controller))
    return run_case(case).metrics


@pytest.mark.parametrize(("robot", "name"), [("hauler", "sm"), ("ringing", "ssm")])
@pytest.mark.parametrize("path", other_robots().trajectories)
def test_identified_model_tracks_slow_and_ringing_robots_better_than_two_delays(robot, name, path):
    model, delays = (drive(robot, str(PATHS / f"{path}.yaml"), driver, 0) for driver in (name, "two_delays"))
    assert model.completed
    assert model.position_rmse_m < 0.8 * delays.position_rmse_m


def test_accelerating_slow_wheels_are_not_reported_as_saturated():
    """A false report would limit this robot to half of its speed, 1.3 m behind its reference."""
    metrics = drive("hauler", "figure8", "sm", 2)
    assert metrics.completed
    assert metrics.position_rmse_m < 0.03
    assert metrics.behind_max_s < 0.2


def test_error_is_split_into_repeatable_part_and_noise():
    noise, heading = 0.002 * np.random.default_rng(3).standard_normal((40, 500)), 0.5 * np.pi
    reference = np.column_stack([np.zeros(500), np.linspace(0.0, 5.0, 500), np.full(500, heading)])
    # Each run is 3 mm ahead, along y, and has noise to the left, along -x.
    runs = [
        SimpleNamespace(
            ended="",
            counted=np.ones(500, dtype=bool),
            reference_pose=reference,
            true_pose=reference + np.column_stack([-row, np.full(500, 0.003), np.zeros(500)]),
        )
        for row in noise
    ]
    rows = DataFrame({"trajectory": "line", "run": runs})
    parts = [float(error_part(rows, component=i, repeats=repeats)) for i in (0, 1) for repeats in (True, False)]
    assert parts == pytest.approx([0.003, 0.0, 0.0, 0.002], abs=2e-4)
