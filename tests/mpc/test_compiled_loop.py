"""Whole drives, compiled and in Python: the same commands, messages and modes to 1e-9."""

import numpy as np
import pytest

from diffdrive_mpc.models import Measurement, Stamped
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.sim import make_plant


def controllers(name, **changes):
    """One compiled, one not; an exact solver, so that rounding is not magnified by a tolerance."""
    config = replace_values(load_config(name), {"solver.backend": "daqp", "horizon": 20, **changes})
    return [Controller(replace_values(config, {"solver.compiled": choice})) for choice in ("always", "never")]


def false_pose(k, m):
    value = np.asarray(m.pose.value) + [2.0, 0.0, 0.0] if m.pose and 100 <= k < 120 else None
    return m if value is None else Measurement(Stamped(value, m.pose.time), m.wheel_twist, m.yaw_rate)


def carried(k, m):
    value = np.asarray(m.pose.value) + [0.15, 0.1, 0.1] if m.pose and k >= 100 else None
    return m if value is None else Measurement(Stamped(value, m.pose.time), m.wheel_twist, m.yaw_rate)


def no_pose(k, m):
    return Measurement(None, m.wheel_twist, m.yaw_rate) if 80 <= k < 130 else m


def nothing(k, m):
    return Measurement() if 80 <= k < 90 else m


def as_it_is(k, m):
    return m


@pytest.mark.parametrize(
    ("name", "plant", "reference", "change"),
    [
        ("ssm", "mujoco", "square", as_it_is),
        ("mbm", "mujoco", "s", as_it_is),
        ("sm", "mujoco", "circle", carried),
        ("ssm", "mujoco", "circle", false_pose),
        ("ssm", "model:ssm", "cane", no_pose),
        ("mbm", "model:sm", "circle", nothing),
    ],
)
def test_a_drive(name, plant, reference, change):
    """Both get the same measurements, those of the plant that the compiled one drives."""
    compiled, python = controllers(name)
    trajectory = load_trajectory(reference)
    driven = make_plant(plant, seed=4)
    driven.reset(trajectory.sample([0.0]).pose[0])
    for controller in (compiled, python):
        controller.start(trajectory, 0.0)
    modes = set()
    for k in range(220):
        t = driven.time
        measurement = change(k, driven.measure())
        got, expected = compiled.step(t, measurement), python.step(t, measurement)
        assert got.command == pytest.approx(expected.command, abs=1e-9)
        assert (got.mode, got.message, got.solver.status) == (expected.mode, expected.message, expected.solver.status)
        if expected.plan is not None:
            assert got.plan == pytest.approx(expected.plan, abs=1e-9)
            assert got.reference == pytest.approx(expected.reference, abs=1e-9)
        modes.add(got.mode)
        driven.advance(got.command)
    assert "TRACKING" in modes


def test_limits_and_weights_change_while_driving():
    compiled, python = controllers("ssm")
    for controller in (compiled, python):
        controller.start(load_trajectory("circle"), 0.0)
    for k in range(60):
        pose = Measurement(Stamped(load_trajectory("circle").sample([k * 0.0202]).pose[0], k * 0.0202))
        if k == 30:
            for controller in (compiled, python):
                controller.update(limits={"v": 0.4}, weights={"across": 90.0})
        got, expected = (controller.step(k * 0.0202, pose) for controller in (compiled, python))
        assert got.command == pytest.approx(expected.command, abs=1e-9)
    assert compiled.compiled
