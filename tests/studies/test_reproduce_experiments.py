"""Experiments of `reproduce`: kinematics, drives, lines, and values from the papers."""

import numpy as np
import pytest

from studies.reproduce.published import load_published, load_study
from studies.reproduce.virtual_track import fit_line


def test_line_is_fitted_for_any_sign_of_the_yaw_rate():
    rates = np.array([-1.0, 0.3, -0.5, 0.9])
    line = fit_line(np.column_stack([rates, 0.05 * np.abs(rates) + 0.3]))
    assert (line.p1, line.p0) == pytest.approx((0.05, 0.3))
    assert line.misfit(np.column_stack([np.abs(rates), 0.05 * np.abs(rates) + 0.3])) < 1e-12


def test_statistics_of_the_papers_are_consistent():
    """RMSE, mean and standard deviation of each published set agree, and averages equal those of the rows."""
    published = load_published()
    error_sets = [errors for rows in published.odometry.values() for errors in rows.values()]
    error_sets += [drive.odometry for drive in published.free_drives]
    for errors in error_sets:
        for rmse, mean, std, maximum in (errors.position, errors.heading):
            assert rmse == pytest.approx(np.hypot(mean, std), abs=0.008)
            assert rmse < maximum
    averages = {"mbm": (0.309, 0.170), "sm": (0.414, 0.239)}
    for model, (position, heading) in averages.items():
        rows = published.odometry[model].values()
        assert np.mean([row.position[0] for row in rows]) == pytest.approx(position, abs=0.0006)
        assert np.mean([row.heading[0] for row in rows]) == pytest.approx(heading, abs=0.0006)
    rows, average = published.free_drives, published.free_drives_average
    assert np.mean([row.values for row in rows], axis=0) == pytest.approx(average.values, abs=0.0051)
    for quantity in ("position", "heading"):
        means = np.mean([getattr(row.odometry, quantity) for row in rows], axis=0)
        assert means == pytest.approx(getattr(average.odometry, quantity), abs=0.0051)
    steps = load_study().cost.simulation_steps
    for name, cost in published.cost.items():
        assert cost.simulation_time[0] == pytest.approx(steps[name] * cost.time_per_step[0], rel=0.01)
