"""Sideways slip is found from poses and gyro."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc.models.identification.fit.slip import lateral_slip
from diffdrive_mpc.models.logs.record import Record

DT, COUNT = 0.02, 3000


def record(side_slip, load_shift, noise, seed=0):
    """A minute of driving in which the lateral speed is what the two terms say."""
    stream, times = np.random.default_rng(seed), DT * np.arange(COUNT)
    v = 0.5 + 0.4 * np.sin(0.9 * times)
    omega = np.sin(0.5 * times) + 0.5 * np.sin(1.7 * times)
    lateral = -side_slip * v * omega + load_shift * np.gradient(v, DT) * omega
    theta = np.concatenate([[0.0], np.cumsum(0.5 * (omega[1:] + omega[:-1])) * DT])
    rate = np.column_stack([v * np.cos(theta) - lateral * np.sin(theta), v * np.sin(theta) + lateral * np.cos(theta)])
    way = np.vstack([np.zeros(2), np.cumsum(0.5 * (rate[1:] + rate[:-1]), axis=0) * DT])
    pose = np.column_stack([way, theta]) + noise * stream.standard_normal((COUNT, 3))
    twist = np.column_stack([v, omega])
    return Record("drive", 0.0, DT, twist, twist=twist, yaw_rate=omega, pose=pose)


@settings(deadline=None, max_examples=20)
@given(side_slip=st.floats(-0.05, 0.15), load_shift=st.floats(-0.05, 0.1))
def test_it_is_found(side_slip, load_shift):
    found = lateral_slip([record(side_slip, load_shift, 0.0)])
    # Windows of a second turn by up to a radian and a half: to the left is not one direction in them.
    assert found.values == pytest.approx([side_slip, load_shift], abs=3e-3)


def test_it_says_how_well():
    errors = []
    for seed in range(20):
        found = lateral_slip([record(0.08, 0.03, 0.005, seed)])
        errors.append((found.values - [0.08, 0.03]) / found.standard_deviation)
    size = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (size > 0.5).all(), size
    assert (size < 2.0).all(), size


def test_without_poses_there_is_none():
    whole = record(0.1, 0.0, 0.0)
    assert lateral_slip([Record("drive", 0.0, DT, whole.command, twist=whole.twist, yaw_rate=whole.yaw_rate)]) is None
    assert lateral_slip([]) is None
