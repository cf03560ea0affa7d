"""The bias of steady arcs, on runs whose lateral error is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from loop_parts import ConstantTwist, run_along
from numpy.typing import ArrayLike

from diffdrive_mpc import integrate_pose, load_trajectory
from diffdrive_mpc.models.interface import ReferenceSample
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from studies.tracking.measured import steady_arc_lateral, steady_arcs

DT = 0.0202


@dataclass(frozen=True)
class TwoArcs:
    """Four seconds to the left, then four to the right, one metre radius, at once from one to the other."""

    duration: float = 8.0
    name: str = "two arcs"

    def sample(self, times: ArrayLike) -> ReferenceSample:
        t = np.clip(np.asarray(times, dtype=float), 0.0, self.duration)
        first = integrate_pose([0.0, 0.0, 0.0], 0.5 * np.minimum(t, 4), 0.5 * np.minimum(t, 4), 1.0)
        rest = np.maximum(t - 4, 0.0)
        pose = integrate_pose(first, 0.5 * rest, -0.5 * rest, 1.0)
        return ReferenceSample(pose, np.column_stack([np.full(len(t), 0.5), np.where(t < 4, 0.5, -0.5)]), 0.5 * t)


def beside(reference, lateral):
    """A run that drives `lateral` (n,) to the left of the reference."""
    times = np.arange(0.0, reference.duration, DT)
    pose = reference.sample(times).pose.copy()
    lateral = np.broadcast_to(lateral, times.shape)
    pose[:, 0] -= lateral * np.sin(pose[:, 2])
    pose[:, 1] += lateral * np.cos(pose[:, 2])
    return run_along(reference, pose, [0.5, 0.0, 0.5], times)


@pytest.mark.parametrize("side", [0.03, -0.02])
def test_a_constant_distance_is_the_bias_with_its_sign(side):
    run = beside(ConstantTwist(0.5, 0.5, 6.0), side)
    assert steady_arc_lateral(run) == pytest.approx([side], abs=1e-5)


def test_each_arc_has_its_own_bias_and_what_happens_before_it_settles_does_not_count():
    reference = TwoArcs()
    times = np.arange(0.0, reference.duration, DT)
    since = np.where(times < 4, times, times - 4)
    settled = np.where(times < 4, -0.010, 0.006)
    run = beside(reference, np.where(since < 1.5 - 1e-9, 0.1, settled))
    assert steady_arc_lateral(run) == pytest.approx([-0.010, 0.006], abs=1e-5)


def test_noise_about_the_bias_averages_out_exactly():
    reference = ConstantTwist(0.5, 0.5, 6.0)
    run = beside(reference, 0.01)
    (ticks,) = steady_arcs(run)
    wave = np.zeros(len(run.time))
    wave[ticks] = 0.004 * (-1.0) ** np.arange(len(ticks))
    expected = 0.01 + wave[ticks].mean()
    assert steady_arc_lateral(beside(reference, 0.01 + wave)) == pytest.approx([expected], abs=1e-5)


@pytest.mark.parametrize("twist", [(0.5, 0.0), (0.0, 1.0)])
def test_straights_and_turns_on_the_spot_are_no_arcs(twist):
    assert steady_arc_lateral(beside(ConstantTwist(*twist, 6.0), 0.0)).shape == (0,)


def test_an_arc_that_ends_before_it_settles_does_not_count():
    reference = ConstantTwist(0.5, 0.5, metric_settings().settled_arc - DT)
    assert steady_arc_lateral(beside(reference, 0.01)).shape == (0,)


def test_backwards_left_of_the_robot_is_right_of_the_path():
    assert steady_arc_lateral(beside(ConstantTwist(-0.5, 0.5, 6.0), 0.01)) == pytest.approx([-0.01], abs=1e-5)


@pytest.mark.parametrize(("name", "arcs"), [("circle", 1), ("square", 0), ("s", 3), ("cane", 1)])
def test_the_shipped_trajectories_have_the_arcs_that_their_files_say(name, arcs):
    reference = load_trajectory(name)
    run = beside(reference, 0.0)
    found = steady_arcs(run)
    assert len(found) == arcs
    for ticks in found:
        assert np.ptp(run.reference_twist[ticks], axis=0) == pytest.approx(0.0, abs=1e-5)
        assert (np.diff(ticks) == 1).all()
