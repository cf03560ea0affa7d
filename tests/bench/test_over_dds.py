"""Node and simulated robot as two processes over DDS, in lock step: the drive is that in one process."""

from dataclasses import replace

import numpy as np
import pytest

from bench.case import Case, build
from bench.ros.compare import COMPARED, compare, comparison_table, timing_table
from bench.ros.two_processes import DriveFailedError, drive_over_dds
from sim import simulate

BOUND = 120.0


def case(trajectory):
    return Case("mpc", "ssm", trajectory, "mujoco", "default", "default", 0)


@pytest.fixture(scope="module", params=["circle", "s"])
def comparison(request):
    return compare(case(request.param), timeout=BOUND)


def test_errors_are_within_20_percent_of_those_in_one_process(comparison):
    for statistic in COMPARED:
        assert 0.8 < comparison.ratio(statistic) < 1.2, statistic
    assert comparison.over_dds.metrics.completed
    assert comparison.timing.misses == 0
    (name, *_), cells = comparison_table([comparison]).rows[0][:2], timing_table([comparison]).rows
    assert name == comparison.case.trajectory and len(cells) == 2


def test_commands_are_those_in_one_process_but_for_what_messages_leave_out(comparison):
    """The node takes no covariance of wheels and gyro from messages; without them in one process nothing differs."""
    controller, plant, reference = build(comparison.case)
    measure = plant.measure

    def as_the_node_sees_it():
        full = measure()
        plain = {name: replace(getattr(full, name), covariance=None) for name in ("wheel_twist", "yaw_rate")}
        return replace(full, **plain)

    plant.measure = as_the_node_sees_it
    alone = simulate(controller, plant, reference)
    assert np.abs(alone.command - comparison.over_dds.command).max() < 1e-9
    assert np.abs(alone.true_pose - comparison.over_dds.true_pose).max() < 1e-9


def test_a_process_that_fails_is_named_with_its_words(tmp_path):
    bad = Case("mpc", "ssm", "circle", "mujoco", "ice", "default", 0)
    with pytest.raises(DriveFailedError, match="robot: ended with code 2; it said: error: unknown surface 'ice'"):
        drive_over_dds(bad, 1.0, tmp_path / "bag", lock_step=True, timeout=BOUND)
