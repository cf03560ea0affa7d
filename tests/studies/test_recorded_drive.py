"""A bag of a drive, read back as a run: its statistics and its times."""

from dataclasses import asdict

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped

from diffdrive_mpc import ConfigError, Stamped
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.ros import messages
from diffdrive_mpc.sim.ros.messages import bag_recorder
from studies.ros.recorded_drive import loop_timing, read_drive

DT = 0.0202
START = 10_100_000_000
REST = 10
CONTROLLER, PLANT, REFERENCE = build(Case(trajectory="cane", plant="model:ssm"))
RUN = simulate(CONTROLLER, PLANT, REFERENCE, extra_time=0.5)
TICKS = len(RUN.time)


def stamp(tick):
    return START + round(1e9 * tick * DT)


def command(value, at):
    message = TwistStamped(twist=messages.twist_message(value))
    message.header.stamp = messages.time_message(at)
    return message


def write(bag, ticks=TICKS, commands=RUN.command):
    """As the robot records it: a while at rest under zero commands, then the run."""
    with bag_recorder(bag) as record:
        for k in range(-REST, ticks):
            now, row = stamp(k), max(k, 0)
            record("/ground_truth/pose", messages.true_pose(now, RUN.true_pose[row]), now)
            record("/ground_truth/twist", messages.true_twist(now, RUN.true_twist[row]), now)
            record("/cmd_vel", command(commands[k] if k >= 0 else (0.0, 0.0), now), now)
    return bag


def test_a_recorded_run_has_the_statistics_of_the_run(tmp_path):
    found = read_drive(write(tmp_path / "bag"), REFERENCE, DT)
    timed = {"step_time_p50_s", "step_time_p95_s", "step_time_p99_s", "step_time_max_s", "deadline_misses", "fallbacks"}
    ours, theirs = asdict(found.metrics), asdict(RUN.metrics)
    # A recording does not hold what happened inside a step.
    timed |= {name for name in ours if name.startswith(("solve_time", "iterations"))}
    # This plant has no motors.
    timed |= {"energy_j", "motor_work_j"}
    for name in ours.keys() - timed:
        assert ours[name] == pytest.approx(theirs[name], rel=1e-9, abs=1e-9), name
    assert found.metrics.completed
    assert np.array_equal(found.command, RUN.command[: len(found.time)])
    assert np.allclose(found.time, RUN.time[: len(found.time)], rtol=0, atol=1e-9)


def test_a_recording_that_ends_early_or_never_drives_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"early: it ends 2\.0 s after the start.*record for longer"):
        read_drive(write(tmp_path / "early", ticks=100), REFERENCE, DT)
    with pytest.raises(ConfigError, match="never drove"):
        read_drive(write(tmp_path / "still", commands=np.zeros_like(RUN.command)), REFERENCE, DT)


def test_times_of_the_loop_are_those_of_stamps_and_receipts(tmp_path):
    """Odometry every sample, a command 3 ms later that takes 1 ms, and one left out."""
    left_out = 40
    with bag_recorder(tmp_path / "bag") as record:
        for k in range(100):
            record("/odom", messages.odometry(stamp(k), (0, 0, 0), Stamped((0.5, 0.0), 0.0)), stamp(k))
            if k != left_out:
                record("/cmd_vel", command((0.5, 0.0), stamp(k) + 3_000_000), stamp(k) + 4_000_000)
    timing = loop_timing(tmp_path / "bag", DT)
    assert (timing.commands, timing.misses) == (99, 1)
    assert timing.period.p50 == pytest.approx(DT) and timing.period.max == pytest.approx(2 * DT)
    assert timing.jitter.p50 < 1e-9 and timing.jitter.max == pytest.approx(DT)
    assert timing.latency.p50 == pytest.approx(0.004) and timing.latency.max == pytest.approx(0.004)
