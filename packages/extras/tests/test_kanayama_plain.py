"""Kanayama's law on the last measured pose, without estimate and prediction."""

from __future__ import annotations

import numpy as np
import pytest
from bench_parts import Arc, DisplacedUnicycle
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc import Measurement, Stamped
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim import simulate
from diffdrive_mpc_extras.peers.kanayama_plain import KanayamaController, load_plain_gains


@settings(max_examples=25, deadline=None)
@given(x=st.floats(-0.2, 0.2), y=st.floats(-0.2, 0.2), theta=st.floats(-0.5, 0.5))
def test_it_converges_from_beside_the_reference(x: float, y: float, theta: float) -> None:
    run = simulate(KanayamaController(), DisplacedUnicycle([x, y, theta]), Arc())
    settled = (run.time > 6.0) & run.counted
    assert run.errors.position[settled].max() < 2e-3 + 0.02 * np.hypot(x, y)
    assert np.abs(run.errors.heading[settled]).max() < 0.02




def test_the_law_is_that_of_the_paper() -> None:
    """Robot on the x axis, reference ahead by 0.02, to the left by 0.01 and turned left by 0.1."""
    gains = load_plain_gains()
    arc = Arc(duration=100.0)
    controller = KanayamaController()
    controller.start(arc, 0.0)
    here = arc.sample([50.0]).pose[0]
    heading = here[2] - 0.1
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    position = here[:2] - 0.02 * ahead - 0.01 * left
    measurement = Measurement(pose=Stamped(np.array([*position, heading]), 50.0))
    for k in range(50):  # until slew no longer binds
        command = controller.step(50.0 + 0.02 * k, measurement).command
    v = 0.5 * np.cos(0.1) + gains.along * 0.02
    omega = 0.3 + 0.5 * (gains.across * 0.01 + gains.heading * np.sin(0.1))
    assert command == pytest.approx([v, omega], abs=1e-9)




def test_commands_stay_inside_limits_and_slew() -> None:
    robot = load_robot()
    run = simulate(KanayamaController(), DisplacedUnicycle([-3.0, 2.0, 2.5]), Arc())
    assert np.abs(run.command[:, 0]).max() <= robot.limits.v
    assert np.abs(run.command[:, 1]).max() <= robot.limits.omega
    change = np.abs(np.diff(run.command, axis=0, prepend=np.zeros((1, 2)))) / run.sample_time
    assert change[:, 0].max() <= robot.command_slew.v * (1 + 1e-9)
    assert change[:, 1].max() <= robot.command_slew.omega * (1 + 1e-9)
    assert change[:, 0].max() == pytest.approx(robot.command_slew.v)


def test_a_late_pose_is_compared_with_the_reference_of_its_own_time() -> None:
    """On the reference at cruising speed there is nothing to correct, however late the pose."""
    arc = Arc()
    controller = KanayamaController()
    controller.start(arc, 0.0)
    for k in range(100):
        t = 0.0202 * k
        step = controller.step(t, Measurement(pose=Stamped(arc.sample([t - 0.06]).pose[0], t - 0.06)))
    assert step.command == pytest.approx([0.5, 0.3], abs=1e-9)


def test_without_a_usable_pose_the_last_error_is_kept() -> None:
    arc = Arc()
    controller = KanayamaController()
    controller.start(arc, 0.0)
    start = Measurement(pose=Stamped(np.array([-0.1, 0.0, 0.0]), 0.0))
    for k in range(60):
        before = controller.step(0.0202 * k, start)
    lost = controller.step(0.0202 * 60, Measurement(pose=Stamped(np.array([np.nan, 0.0, 0.0]), 1.2)))
    none = controller.step(0.0202 * 61, Measurement())
    assert lost.command == pytest.approx(before.command)
    assert none.command == pytest.approx(before.command)
    assert "not finite" in lost.message
    assert none.message == before.message == ""




def test_a_step_of_the_plain_law_before_the_start_is_a_fault() -> None:
    with pytest.raises(RuntimeError, match="start"):
        KanayamaController().step(0.0, Measurement())
