"""Simulated run: recorded data and energy."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from loop_parts import ConstantTwist, FeedForward, KinematicPlant, run_along

from diffdrive_mpc import Measurement
from diffdrive_mpc.models.interface import FloatArray, Stamped
from diffdrive_mpc.sim import Run, simulate

CIRCLE = ConstantTwist(v=0.5, omega=0.5, duration=1.0, name="circle")
ESTIMATE = np.arange(0.1, 1.05, 0.1)


class DetailedController(FeedForward):
    """Controller that reports an estimate from the second tick on, and a solver result at every second tick."""

    def step(self, t: float, measurement: Measurement) -> SimpleNamespace:  # type: ignore[override]
        command = super().step(t, measurement).command
        k = self._tick - 1
        names, values = ("pose", "twist", "pose_deviation", "twist_deviation"), np.split(k + ESTIMATE, [3, 5, 8])
        estimate = SimpleNamespace(**dict(zip(names, values, strict=True))) if k else None
        solver = SimpleNamespace(status="solved", method="unlimited", iterations=3) if k % 2 else None
        details = {"mode": "TRACKING", "message": "", "step_time": 1e-3, "solve_time": 4e-4}
        return SimpleNamespace(command=command, estimate=estimate, solver=solver, plan=plan_of(k), **details)


def plan_of(k: int) -> FloatArray | None:
    return k + np.arange(12.0).reshape(4, 3) if k % 2 else None


@pytest.fixture(scope="module")
def run() -> Run:
    return simulate(DetailedController(), KinematicPlant(), CIRCLE)


def test_run_contains_the_estimates_and_solver_results_of_a_controller(run: Run) -> None:
    assert np.isnan(run.estimates[0]).all() and np.isnan(run.estimate_deviations[0]).all()
    np.testing.assert_array_equal(run.estimates[3], 3 + ESTIMATE[:5])
    np.testing.assert_array_equal(run.estimate_deviations[3], 3 + ESTIMATE[5:])
    assert run.solver_methods[:3] == ("none", "unlimited", "none")
    assert run.solver_statuses[:3] == ("", "solved", "")
    assert len(run.solver_methods) == len(run.solver_statuses) == len(run.time)
    np.testing.assert_array_equal(run.solver_iterations[:3], [np.nan, 3.0, np.nan])
    assert (run.solve_time == 4e-4).all() and run.metrics.solve_time_max_s == 4e-4
    assert (run.metrics.iterations_mean, run.metrics.iterations_max) == (3.0, 3.0)


def test_run_of_a_controller_without_details_has_empty_rows() -> None:
    for item in (simulate(FeedForward(), KinematicPlant(), CIRCLE), run_along(CIRCLE, [0, 0, 0], [0, 0, 0], [0, 1])):
        n = len(item.time)
        assert item.estimates.shape == item.estimate_deviations.shape == (n, 5)
        assert np.isnan(item.estimates).all()
        assert item.solver_methods == ("none",) * n
        assert item.solver_statuses == ("",) * n
        assert {len(column) for column in item.columns.values()} == {n}


def test_errors_use_the_true_motion_during_the_reference() -> None:
    """Along the x axis at 1 m/s for 2 s, side slip 0.1 m/s; measurements, estimates and commands differ widely."""
    times = np.arange(7) / 2
    ahead, left = np.array([[0.08, 0.06]] * 2 + [[0.04, -0.03]] * 3 + [[3.0, 4.0]] * 2).T
    truth = np.column_stack([np.minimum(times, 2.0) + ahead, left, np.full(7, 0.2)])
    far_measurement = Measurement(pose=Stamped(np.ones(3), 0.0), wheel_twist=Stamped(np.ones(2), 0.0))
    run = replace(
        run_along(ConstantTwist(1.0, 0.0, 2.0), truth, [1.0, 0.1, 0.0], times),
        measurements=(far_measurement,) * 7, estimates=np.ones((7, 5)), command=np.ones((7, 2)), disturbance=(0.0, 0.0),
    )  # fmt: skip
    assert run.errors.position == pytest.approx([0.10] * 2 + [0.05] * 3 + [5.0] * 2)
    assert run.errors.lateral[:5] == pytest.approx([0.06] * 2 + [-0.03] * 3)
    assert run.errors.heading == pytest.approx(np.full(7, 0.2))
    assert run.errors.course[:5] == pytest.approx(np.full(5, 0.2 + np.arctan(0.1)))
    assert (run.metrics.steps, run.metrics.position_rmse_m) == (5, pytest.approx(np.sqrt((2 * 0.01 + 3 * 0.0025) / 5)))
    assert (run.recovery.lateral_max_m, run.recovery.recovery_time_s) == (pytest.approx(0.06), 1.0)
    assert run.recovery.command_energy_omega == pytest.approx(5 * 0.5)
    assert replace(run, ended="lost").recovery.recovery_time_s == np.inf


def test_plans_are_recorded_on_request(run: Run) -> None:
    assert run.plans.shape == (0, 0, 3)
    with_plans = simulate(DetailedController(), KinematicPlant(), CIRCLE, keep_plans=True)
    assert with_plans.plans.shape == (len(run.time), 4, 3)
    np.testing.assert_array_equal(with_plans.plans[1::2], [plan_of(k) for k in range(1, len(run.time), 2)])
    assert np.isnan(with_plans.plans[::2]).all()
    np.testing.assert_array_equal(with_plans.command, run.command)
    assert simulate(FeedForward(), KinematicPlant(), CIRCLE, keep_plans=True).plans.shape == (len(run.time), 0, 3)


def test_run_is_converted_to_a_dataframe(run: Run) -> None:
    table = run.to_dataframe()
    assert isinstance(table, pd.DataFrame)
    assert list(table.columns) == list(run.columns)
    assert len(table) == len(run.time)
    np.testing.assert_array_equal(table["estimate_y_sd_m"], run.estimate_deviations[:, 1])
    np.testing.assert_array_equal(table[["v_ref_m_s", "omega_ref_rad_s"]], run.command)
    assert table["solver_path"].value_counts().to_dict() == {"none": 26, "unlimited": 25}
    assert table["t_s"].dtype == float
