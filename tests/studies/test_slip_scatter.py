"""Poses that are foreseen with learned slip: how errors are held against what was foreseen of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.bench.plain_values import plain
from studies.reproduce.published import ScatterFloor, load_study
from studies.reproduce.slip_scatter import Foresight, scatter_of


@given(st.integers(0, 50), st.floats(-3, 3), st.floats(0.1, 5))
def test_errors_that_are_as_they_were_foreseen_are_consistent_in_every_frame(seed, angle, scale):
    """Drawn from their own covariances: 95 % inside, NEES one; another frame or unit of length changes neither."""
    random = np.random.default_rng(seed)
    roots = random.normal(size=(800, 3, 3)) + 2 * np.eye(3)
    errors = (roots @ random.normal(size=(800, 3, 1)))[..., 0]
    found = Foresight(errors, roots @ roots.transpose(0, 2, 1))
    assert found.inside == pytest.approx(0.95, abs=0.04)
    assert found.nees.mean() == pytest.approx(1.0, abs=0.12)
    c, s = np.cos(angle), np.sin(angle)
    turn = scale * np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = Foresight(errors @ turn.T, turn @ found.covariances @ turn.T)
    assert turned.nees == pytest.approx(found.nees, rel=1e-6)
    assert turned.inside == pytest.approx(found.inside, abs=0.002)
    assert turned.foreseen[2] == pytest.approx(scale * found.foreseen[2])


@given(st.floats(0.2, 5), st.floats(0.2, 5), st.floats(0.2, 5))
def test_factors_scale_deviations_and_leave_correlations(along, left, heading):
    random, factors = np.random.default_rng(1), np.array([along, left, heading])
    roots = random.normal(size=(5, 3, 3)) + 2 * np.eye(3)
    before = Foresight(random.normal(size=(5, 3)), roots @ roots.transpose(0, 2, 1))
    after = before.scaled(factors)
    assert after.foreseen == pytest.approx(factors * before.foreseen)
    assert np.array_equal(after.errors, before.errors)

    def correlations(shapes):
        sizes = np.sqrt(np.diagonal(shapes, axis1=1, axis2=2))
        return shapes / sizes[:, :, None] / sizes[:, None, :]

    assert correlations(after.covariances) == pytest.approx(correlations(before.covariances))


def test_learned_slip_tells_where_the_robot_will_be_and_a_seed_fixes_it():
    study = load_study(quick=True).slip_scatter.model_copy(update={"duration": 28.0})
    floor = ScatterFloor(plant="model:ssm", surface="p4_grass")
    found, again = scatter_of(study, floor, 0.1, 4), scatter_of(study, floor, 0.1, 4)
    assert plain(found) == plain(again)
    assert (found.learned.rms < 0.2 * found.nominal.rms).all()
    assert np.linalg.eigvalsh(found.learned.covariances).min() > 0
    # What slip adds is a part of the whole.
    assert (found.by_slip < found.learned.foreseen).all()
    # The floor takes a third of the yaw rate.
    assert found.coefficients[7] == pytest.approx(found.truth[7], abs=0.03)
    one, other = found.paths["driven"], found.paths["learned slip"]
    assert np.array_equal(found.paths["no slip"][0], other[0])
    assert np.hypot(*(one - other).T).max() < np.hypot(*(one - found.paths["no slip"]).T).max()
