"""Lifecycle, services, references from topics, and published messages of the node over DDS."""

import itertools
import math
import pkgutil

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import GetState
from nav_msgs.msg import Path
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_parts import CONFIG, DT, stack
from std_msgs.msg import String
from test_ros_frames import straight_path
from visualization_msgs.msg import Marker

from diffdrive_mpc.mpc import Controller, load_trajectory
from diffdrive_mpc.mpc.ros.control_loop import LoopState
from diffdrive_mpc.mpc.ros.conversions import time_message
from diffdrive_mpc.mpc.step_result import Mode
from diffdrive_mpc.sim import make_plant, simulate

LENGTH = 1.6 / 1.5
"""Length of a path of 4 s [m]."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def state(s):
    return s.call(GetState, "/diffdrive_mpc/get_state", GetState.Request()).current_state.id


def test_commands_in_lock_step_equal_commands_of_the_simulation():
    reference = load_trajectory("s")
    ticks = 150
    with stack(trajectory="s", drive=True) as s:
        s.base.plant.reset((0.0, 0.0, 0.0))
        commands = s.base.run(ticks)
    run = simulate(Controller(CONFIG), make_plant("model:ssm+0.005", surface="ideal", sensors="perfect"), reference)
    np.testing.assert_allclose(commands, run.command[:ticks], atol=1e-6)


def test_robot_on_the_wall_clock_drives_and_stops_without_odometry():
    """No duration is asserted, because it depends on the machine."""
    with stack(sim_time=False, drive=True, odom_timeout=2.0) as s:

        def has_moved():
            # A machine that stands still for a second stops the drive, as it should.
            if s.loop.last is not None and s.loop.last.mode == Mode.STOPPED:
                s.trigger("resume")
            return s.base.plant.true_pose[0] > 0.1

        s.base.until(has_moved, "the robot to move")
        assert s.loop.times.latency.percentiles().p50 > 0.0
        s.base.tamper = lambda odometry: None
        s.base.until(lambda: s.loop.last.mode == Mode.STOPPED, "the robot to stop")
        # DDS may not have delivered the command of the first STOPPED tick yet.
        s.base.until(lambda: s.base.commands[-1] == (0.0, 0.0), "the zero command")
        count = len(s.base.commands)
        s.base.until(lambda: len(s.base.commands) > count + 3, "further commands")
        assert set(s.base.commands[count:]) == {(0.0, 0.0)}


@pytest.mark.parametrize("offset", [1.0, 100.0, 1000.0])
def test_one_future_stamp_rejects_one_message_only(offset):
    """One future stamp on each topic does not affect later messages."""
    with stack(drive=True, pose_topic=True) as s:
        s.base.run(30)
        topics = s.node._inbox.topics
        counts = [topic.accepted for topic in topics]
        s.base.ahead = int(offset * 1e9)
        s.base.run(1)
        s.base.ahead = 0
        commands = s.base.run(20)
        assert s.loop.last.mode == Mode.TRACKING
        assert [topic.accepted for topic in topics] == [count + 20 for count in counts]
        assert all("s in the future" in topic.last_refusal for topic in topics)
        assert not any(topic.reason for topic in topics)
        assert commands[-1, 0] > 0.1


def test_failed_configuration_reports_its_reason():
    with stack(autostart=False, trajectory="circel") as s:
        assert not s.change(Transition.TRANSITION_CONFIGURE)
        assert "unknown trajectory 'circel'" in s.node.failure
        assert state(s) == State.PRIMARY_STATE_UNCONFIGURED


BUILDERS = "diffdrive_mpc.mpc.ros.node."
PARTS = ("references", "speed_limit", "follow_path", "bond", "rivals", "recording")
STEPS = {name: (BUILDERS + name, 0) for name in ("load_trajectory", "check_speeds", "Controller", "Frames", "listen")}
STEPS |= {name: (BUILDERS + name, 0) for name in ("Inbox", "Publishers", "SideProcess", "NodeTools")}
STEPS |= {f"subscription {count}": (BUILDERS + "subscribe_bounded", count) for count in (0, 1)}
STEPS |= {f"guard condition {count}": (f"{BUILDERS}TrackingNode.create_guard_condition", count) for count in (0, 1)}
STEPS |= {"timer": (f"{BUILDERS}TrackingNode.create_timer", 0)}


def entity_counts(node):
    groups = (node.publishers, node.subscriptions, node.services, node.timers, node.guards, node._managed_entities)
    return [len(list(group)) for group in groups]


def fail_at(monkeypatch, target, count, error):
    """Raise `error` at call number `count` of a step of the configuration."""
    owner, _, name = target.rpartition(".")
    owner = pkgutil.resolve_name(owner.replace("node.TrackingNode", "node:TrackingNode"))
    step, calls = getattr(owner, name), itertools.count()

    def run(*arguments, **options):
        if next(calls) == count:
            raise error
        return step(*arguments, **options)

    monkeypatch.setattr(owner, name, run)


def check_failed_configuration(s, monkeypatch, capfd, *step):
    counts = entity_counts(s.node)
    with monkeypatch.context() as patch:
        fail_at(patch, *step)
        capfd.readouterr()
        s.node.trigger_configure()
        lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 and "no memory" in lines[0]
    assert "no memory" in s.node.failure
    assert (s.state, s.node.label) == ((State.PRIMARY_STATE_UNCONFIGURED, "unconfigured"), "unconfigured")
    assert entity_counts(s.node) == counts, step


@pytest.mark.parametrize("error", [ValueError("no memory"), RuntimeError("no memory")], ids=type)
def test_failed_step_of_the_configuration_leaves_the_node_unconfigured(error, monkeypatch, capfd):
    monkeypatch.setattr("diffdrive_mpc.mpc.ros.node.listen", lambda *_, **__: [])
    with stack(autostart=False, use_tf=True) as s:
        for target, count in STEPS.values():
            check_failed_configuration(s, monkeypatch, capfd, target, count, error)
        for name in PARTS:
            target = f"{type(s.node.parts[name]).__module__}:{type(s.node.parts[name]).__name__}.configure"
            check_failed_configuration(s, monkeypatch, capfd, target, 0, error)
        assert s.change(Transition.TRANSITION_CONFIGURE)
        assert s.change(Transition.TRANSITION_ACTIVATE)


def test_trajectory_starts_at_the_robot():
    with stack(start_at_robot=True) as s:
        s.base.plant.reset((2.0, -1.0, 2.0))
        s.base.run(2)
        assert s.trigger("start").success
        s.base.run(40)
        assert s.loop.last.mode == Mode.TRACKING
        np.testing.assert_allclose(s.loop.drive.reference.sample([0.0]).pose[0], [2.0, -1.0, 2.0], atol=1e-6)
        displacement = s.base.plant.true_pose - [2.0, -1.0, 2.0]
        assert math.cos(2.0) * displacement[0] + math.sin(2.0) * displacement[1] > 0.15


def publish_path(s, path):
    publisher = s.publisher(Path, "set_path")
    s.base.silent(5)
    publisher.publish(path)


def path_along_x(frame="odom"):
    return straight_path(frame, (0.0, 0.0, 0.0), length=LENGTH)


def test_timed_path_is_followed():
    with stack(trajectory="''", drive_on_reference=True) as s:
        assert "there is no reference" in s.trigger("start").message
        publish_path(s, path_along_x())
        s.base.until(lambda: s.base.silent(1) and s.loop.state is LoopState.DRIVING, "the reference")
        s.base.plant.reset((0.0, 0.0, 0.0))
        s.base.run(round(4.6 / DT))
        assert s.loop.last.mode == Mode.FINISHED
        assert abs(s.base.plant.true_pose[0] - LENGTH) < 0.03


def path_without_stamps():
    path = path_along_x()
    for pose in path.poses:
        pose.header.stamp = time_message(0)
    return path


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        (path_along_x("map"), "its frame_id is 'map', expected 'odom'"),
        (path_without_stamps(), "is not later than the previous pose"),
    ],
)
def test_invalid_path_is_rejected_and_the_previous_path_continues(path, reason, capfd):
    with stack(drive=True) as s:
        s.base.run(10)
        publish_path(s, path)
        s.base.until(lambda: reason in capfd.readouterr().err, "the refusal")
        assert s.loop.state is LoopState.DRIVING
        assert s.loop.drive.reference.name == "circle"


def test_paths_marker_error_and_mode_are_published():
    with stack(visual_rate=50.0) as s:
        prediction, reference = s.listen(Path, "/diffdrive_mpc/predicted_path"), []
        marker, error = (
            s.listen(Marker, "/diffdrive_mpc/error_marker"),
            s.listen(Vector3Stamped, "/diffdrive_mpc/tracking_error"),
        )
        mode = s.listen(String, "/diffdrive_mpc/mode", LATCHED)
        s.base.run(5)
        s.trigger("start")
        s.base.run(40)
        reference = s.listen(Path, "/diffdrive_mpc/reference_path", LATCHED)
        s.base.until(lambda: reference and prediction and marker and error, "visuals")
        assert len(prediction[-1].poses) == CONFIG.horizon + 1
        assert prediction[-1].header.frame_id == reference[-1].header.frame_id == marker[-1].header.frame_id == "odom"
        circle = np.array([(pose.pose.position.x, pose.pose.position.y) for pose in reference[-1].poses])
        np.testing.assert_allclose(np.hypot(circle[:, 0], circle[:, 1] - 1.0), 1.0, atol=1e-3)
        assert np.hypot(error[-1].vector.x, error[-1].vector.y) < 0.05
        assert mode[-1].data == "TRACKING"


def test_diagnostics_contain_times_ages_and_faults():
    # The window contains only ticks in lock step, because discovery may lose earlier ticks.
    with stack(diagnostics_rate=20.0, statistics_window=50) as s:
        received = s.listen(DiagnosticArray, "/diagnostics")
        s.trigger("start")
        s.base.run(60)
        s.base.until(lambda: received and received[-1].status[0].message.startswith("TRACKING"), "diagnostics")
        status = received[-1].status[0]
        values = {item.key: item.value for item in status.values}
        assert status.level == DiagnosticStatus.OK
        assert values["solver"].startswith("solved")
        p50, p99, maximum = map(float, values["step time p50/p99/max [ms]"].split(" / "))
        assert 0.0 < p50 <= p99 <= maximum
        assert values["period jitter p50/p99/max [ms]"] == "0.00 / 0.00 / 0.00"
        assert float(values["odometry age [s]"]) == pytest.approx(0.0, abs=DT)
        assert "pose age [s]" not in values
        s.base.gyro = False
        s.base.run(15)
        received.clear()
        s.base.until(lambda: received, "diagnostics")
        assert received[-1].status[0].level == DiagnosticStatus.WARN
        assert "TRACKING: imu is 0." in received[-1].status[0].message


def test_infeasible_reference_is_reported_and_followed():
    with stack({"limits.wheel_speed": 0.45}, diagnostics_rate=20.0) as s:
        received = s.listen(DiagnosticArray, "/diagnostics")
        response = s.trigger("start")
        assert response.success and "'circle': infeasible from" in response.message
        assert "limits.wheel_speed = 0.45" in response.message
        assert s.base.run(30)[-1, 0] > 0.1
        s.base.until(lambda: received and "infeasible" in received[-1].status[0].message, "diagnostics")
        assert received[-1].status[0].level == DiagnosticStatus.WARN
        s.loop.shortfall = ""
        s.loop.follow(s.loop.reference)
        assert "infeasible" in s.loop.shortfall
