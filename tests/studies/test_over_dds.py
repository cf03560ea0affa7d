"""Drives over DDS: recorded, compared with those in one process, and watched."""

import time
from contextlib import contextmanager
from dataclasses import asdict, replace

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data

from diffdrive_mpc import ConfigError, Stamped
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.models.logs.bag_topics import COMMANDS, opened, read_topic
from diffdrive_mpc.models.logs.mapping import Topic
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.ros import messages
from diffdrive_mpc.sim.ros.messages import bag_recorder
from diffdrive_mpc.sim.ros.simulated_base import SHIPPED
from studies.ros.compare import COMPARED, compare, comparison_table, timing_table
from studies.ros.recorded_drive import loop_timing, read_drive
from studies.ros.two_processes import DriveFailedError, drive_over_dds, own_domain, running

BOUND = 120.0
MAGIC = b"\x89MCAP0\r\n"


def case(trajectory):
    return Case(trajectory=trajectory)


@pytest.fixture(scope="module")
def comparison(tmp_path_factory):
    """The clock is repeated all the time, as on a machine where every answer is late."""
    base = tmp_path_factory.mktemp("base") / "base.yaml"
    shipped = SHIPPED.read_text(encoding="utf-8")
    base.write_text(shipped.replace("clock_repeat: 0.05 ", "clock_repeat: 0.0005 "), encoding="utf-8")
    assert base.read_text(encoding="utf-8") != shipped
    return compare(case("s"), timeout=BOUND, settings=base)


def test_errors_are_within_20_percent_of_those_in_one_process(comparison):
    for statistic in COMPARED:
        assert 0.8 < comparison.ratio(statistic) < 1.2, statistic
    assert comparison.over_dds.metrics.completed
    assert comparison.timing.misses == 0
    assert [row[0] for row in comparison_table([comparison]).rows] == 4 * [comparison.case.trajectory]
    assert [row[1] for row in timing_table([comparison]).rows] == ["period", "jitter", "odometry to command"]


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
    bad = Case(surface="sand")
    with pytest.raises(DriveFailedError, match="robot: ended with code 2; it said: error: unknown surface 'sand'"):
        drive_over_dds(bad, 1.0, tmp_path / "bag", lock_step=True, timeout=BOUND)


@contextmanager
def true_twists(environment):
    """A function that waits for the next true twist of the robot and returns its v and omega."""
    context, arrived = Context(), []
    rclpy.init(context=context, domain_id=int(environment["ROS_DOMAIN_ID"]))
    node = rclpy.create_node("watcher", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    node.create_subscription(TwistStamped, "ground_truth/twist", arrived.append, qos_profile_sensor_data)

    def following():
        end = time.monotonic() + BOUND
        arrived.clear()
        while not arrived:
            assert time.monotonic() < end
            executor.spin_once(timeout_sec=0.1)
        return arrived[-1].twist.linear.x, arrived[-1].twist.angular.z

    try:
        yield following
    finally:
        executor.shutdown()
        node.destroy_node()
        context.shutdown()


def test_a_robot_stops_when_its_controller_is_killed(tmp_path, monkeypatch):
    """No zero is sent then: the robot's own timeout has to act."""
    environment, bag = own_domain(tmp_path), tmp_path / "bag"
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    node = ["node", "--drive", "--ros-args", "-p", "use_sim_time:=true", "-p", "use_pose_topic:=true"]
    node += ["-p", "record:=true", "-p", f"record_folder:={tmp_path / 'drives'}"]
    robot = ["sim-robot", "--lock-step", "--answer-timeout", "0.05", "--record", str(bag)]
    with (
        running("node", node, environment, tmp_path) as controller,
        running("robot", robot, environment, tmp_path) as base,
        true_twists(environment) as following,
    ):
        while following()[0] < 0.3:
            assert controller.popen.poll() is None and base.popen.poll() is None
        controller.popen.kill()
        while np.abs(following()).max() > 0.01:
            assert base.popen.poll() is None
        assert "no command on /cmd_vel for 0.5 s: the robot stops" in base.output
    with opened(bag) as reader:
        commands = read_topic(reader, bag, Topic(topic="/cmd_vel"), COMMANDS)
        truth = read_topic(reader, bag, Topic(topic="/ground_truth/twist"), COMMANDS)
    assert commands.value[-1, 0] > 0.2
    since = 1e-9 * (truth.stamped - commands.received[-1])
    assert np.all(truth.value[(since > 0) & (since < 0.5), 0] > 0.2)
    assert 0.5 < since[-1] < 1.5
    check_record(tmp_path / "drives", commands)


def check_record(folder, commands):
    """The node's own file is whole although the node was killed, and holds every command that the robot got."""
    (path,) = folder.iterdir()
    end = time.monotonic() + BOUND
    while not path.read_bytes().endswith(MAGIC):
        assert time.monotonic() < end
        time.sleep(0.05)
    with opened(path) as reader:
        said = read_topic(reader, path, Topic(topic="/cmd_vel"), COMMANDS)
    decided = dict(zip(said.stamped.tolist(), said.value.tolist(), strict=True))
    # The last may have been sent in the tick in which the node was killed.
    sent = dict(zip(commands.stamped.tolist()[:-1], commands.value.tolist(), strict=False))
    assert len(sent) > 10 and {stamp: decided[stamp] for stamp in sent} == sent


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
