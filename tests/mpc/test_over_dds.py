"""Drives over DDS: recorded, compared with drives in one process, and monitored."""

import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from recorded_drive import missed_samples, read_drive
from two_processes import DriveFailedError, drive_over_dds, own_domain, running

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.models.logs.bag_topics import COMMANDS, TopicRequest, open_bag, read_topics
from diffdrive_mpc.models.logs.mapping import Topic
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.ros.simulated_base import SETTINGS_FILE

pytestmark = pytest.mark.system

BOUND = 120.0
CASE = Case(trajectory="s")
MAGIC = b"\x89MCAP0\r\n"


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Return a drive over DDS and its missed samples; the base repeats the clock often, as for late responses."""
    folder = tmp_path_factory.mktemp("drive")
    base = folder / "base.yaml"
    shipped = SETTINGS_FILE.read_text(encoding="utf-8")
    base.write_text(shipped.replace("clock_repeat: 0.05 ", "clock_repeat: 0.0005 "), encoding="utf-8")
    assert base.read_text(encoding="utf-8") != shipped
    _, plant, reference = build(CASE)
    drive_over_dds(CASE, reference.duration, folder / "bag", lock_step=True, timeout=BOUND, settings=base)
    run = read_drive(folder / "bag", reference, plant.sample_time)
    return run, missed_samples(folder / "bag", plant.sample_time)


def test_commands_over_dds_equal_commands_in_one_process(drive):
    """The node ignores covariances of wheels and gyro; the drive in one process omits them as well."""
    controller, plant, reference = build(CASE)
    measure = plant.measure

    def measure_without_covariance():
        measurement = measure()
        parts = {name: replace(getattr(measurement, name), covariance=None) for name in ("wheel_twist", "yaw_rate")}
        return replace(measurement, **parts)

    plant.measure = measure_without_covariance
    expected = simulate(controller, plant, reference)
    assert np.abs(expected.command - drive[0].command).max() < 1e-9
    assert np.abs(expected.true_pose - drive[0].true_pose).max() < 1e-9
    assert drive[0].metrics.completed and drive[1] == 0


def test_failing_process_is_reported_with_its_output(tmp_path):
    case = Case(surface="sand")
    with pytest.raises(DriveFailedError, match="robot: ended with code 2; output: error: unknown surface 'sand'"):
        drive_over_dds(case, 1.0, tmp_path / "bag", lock_step=True, timeout=BOUND)


@contextmanager
def true_twists(environment):
    """Yield a function that waits for the next true twist of the robot and returns its v and omega."""
    context, messages = Context(), []
    rclpy.init(context=context, domain_id=int(environment["ROS_DOMAIN_ID"]))
    node = rclpy.create_node("watcher", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    node.create_subscription(TwistStamped, "ground_truth/twist", messages.append, qos_profile_sensor_data)

    def next_twist():
        deadline = time.monotonic() + BOUND
        messages.clear()
        while not messages:
            assert time.monotonic() < deadline
            executor.spin_once(timeout_sec=0.1)
        return messages[-1].twist.linear.x, messages[-1].twist.angular.z

    try:
        yield next_twist
    finally:
        executor.shutdown()
        node.destroy_node()
        context.shutdown()


def test_robot_stops_if_its_controller_is_killed(tmp_path, monkeypatch):
    """A killed controller sends no zero command: the timeout of the base must stop the robot."""
    environment, bag = own_domain(tmp_path), tmp_path / "bag"
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    node = ["node", "--drive", "--ros-args", "-p", "use_sim_time:=true", "-p", "use_pose_topic:=true"]
    node += ["-p", "record:=true", "-p", f"record_folder:={tmp_path / 'drives'}"]
    robot = ["sim-robot", "--lock-step", "--answer-timeout", "0.05", "--record", str(bag)]
    with (
        running("node", node, environment, tmp_path) as controller,
        running("robot", robot, environment, tmp_path) as base,
        true_twists(environment) as next_twist,
    ):
        while next_twist()[0] < 0.3:
            assert controller.popen.poll() is None and base.popen.poll() is None
        controller.popen.kill()
        while np.abs(next_twist()).max() > 0.01:
            assert base.popen.poll() is None
        assert "no command on /cmd_vel for 0.5 s: the robot stops" in base.output
    with open_bag(bag) as reader:
        requests = {name: TopicRequest(Topic(topic=name), COMMANDS) for name in ("/cmd_vel", "/ground_truth/twist")}
        commands, truth = read_topics(reader, bag, requests).values()
    assert commands.value[-1, 0] > 0.2
    elapsed = 1e-9 * (truth.stamped - commands.received[-1])
    assert np.all(truth.value[(elapsed > 0) & (elapsed < 0.5), 0] > 0.2)
    assert 0.5 < elapsed[-1] < 1.5
    check_record(tmp_path / "drives", commands)


def check_record(folder, commands):
    """Check that the file of a killed node is complete and contains every command that the robot received."""
    (path,) = folder.iterdir()
    deadline = time.monotonic() + BOUND
    while not path.read_bytes().endswith(MAGIC):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    with open_bag(path) as reader:
        recorded = read_topics(reader, path, {"commands": TopicRequest(Topic(topic="/cmd_vel"), COMMANDS)})["commands"]
    by_stamp = dict(zip(recorded.stamped.tolist(), recorded.value.tolist(), strict=True))
    # The last command may have been sent in the tick in which the node was killed.
    received = dict(zip(commands.stamped.tolist()[:-1], commands.value.tolist(), strict=False))
    assert len(received) > 10 and {stamp: by_stamp[stamp] for stamp in received} == received
