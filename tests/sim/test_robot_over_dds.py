"""The simulated robot over DDS: its topics, those of navigation, and its process."""

import math
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import rclpy
import ros_driver
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from ros_driver import BOUND, Driver, own_domain, recorded, recorded_truth
from sensor_msgs.msg import LaserScan

from commands import invoke
from diffdrive_mpc import ConfigError, RobotLostError, make_plant
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop
from diffdrive_mpc.sim.ros.messages import nanoseconds
from diffdrive_mpc.sim.ros.pace import SteppedClock
from diffdrive_mpc.sim.ros.run_robot import run_robot
from diffdrive_mpc.sim.ros.simulated_base import BaseSettings, SimulatedBase, load_base_settings
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from diffdrive_mpc_extras.ros.navigation_topics import Scanner
from diffdrive_mpc_extras.worlds.shapes import Mover
from diffdrive_mpc_extras.worlds.world import World

DT = load_robot().sample_time
TICKS = 60


def settings(answer_timeout=30.0, **changes):
    lock_step = {"lock_step.answer_timeout": answer_timeout, "lock_step.clock_repeat": 0.02}
    return load_base_settings(changes=lock_step | changes)


@pytest.fixture(autouse=True)
def ros(monkeypatch, tmp_path):
    own_domain(monkeypatch, tmp_path / "ros")


def commands(ticks=TICKS, seed=0):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform([-0.5, -1.0], [0.8, 1.0], (ticks // 10, 2)), 10, axis=0)


def driven(bag, rows, *, plant="mujoco", seed=0, base=None, ticks=None, start=(1.0, 2.0, 0.5), storage="mcap", **how):
    """Drive in lock step and record; the driver."""
    base = base or settings()
    with Driver(rows, DT, stamped=base.stamped, **how) as driver:
        run_robot(
            make_plant(plant, seed=seed),
            start,
            base,
            load_sensor_set("default"),
            lock_step=True,
            duration=(ticks or len(rows)) * DT,
            record=bag,
            storage=storage,
        )
    return driver


def test_lock_step_repeats_the_run_without_ros_bit_for_bit(tmp_path):
    rows = commands()
    for name in ("one", "two"):
        driven(tmp_path / name, rows, seed=3)
    log = drive_open_loop(make_plant("mujoco", seed=3), rows, (1.0, 2.0, 0.5))
    truth = recorded_truth(tmp_path / "one")
    assert np.array_equal(truth, recorded_truth(tmp_path / "two"))
    assert np.array_equal(truth[:, :2], log.true_pose[:, :2])
    assert np.allclose(truth[:, 2], log.true_pose[:, 2], rtol=0, atol=1e-14)
    assert np.ptp(truth[:, 0]) > 0.1
    stamps, _ = recorded(tmp_path / "one", "/ground_truth/pose")
    assert np.array_equal(np.diff(stamps), np.full(TICKS - 1, 20_200_000))


@pytest.mark.parametrize(("stamped", "storage"), [(True, "mcap"), (False, "sqlite3")])
def test_a_recording_is_the_log_of_the_drive(tmp_path, stamped, storage):
    """Commands, encoders, gyro and poses as `read_log` gives them are those of the same drive without ROS."""
    rows = commands(200, seed=1)
    driven(tmp_path / "bag", rows, seed=2, base=settings(stamped=stamped), storage=storage)
    log = drive_open_loop(make_plant("mujoco", seed=2), rows, (1.0, 2.0, 0.5))
    (drive,) = read_log(tmp_path / "bag", "simulated_robot").records
    assert drive.dt == pytest.approx(DT, abs=1e-12)
    assert np.array_equal(drive.command, log.command)
    assert np.allclose(drive.twist, log.wheel_twist, rtol=0, atol=1e-9)
    assert np.allclose(drive.yaw_rate, log.yaw_rate, rtol=0, atol=1e-9)
    plant = make_plant("mujoco", seed=2)
    plant.reset((1.0, 2.0, 0.5))
    sensed = []
    for row in rows:
        sensed.append(plant.measure().pose)
        plant.advance(row)
    stamps, poses = recorded(tmp_path / "bag", "/pose")
    assert np.array_equal(stamps - stamps[0], [round(1e9 * (p.time - sensed[0].time)) for p in sensed])
    assert [p.pose.pose.position.x for p in poses] == [p.value[0] for p in sensed]
    assert poses[0].pose.covariance[0] == sensed[0].covariance[0][0]


class EveryOther(Driver):
    """A controller with twice the period of the robot."""

    def answer(self, message):
        if round((message.clock.sec + 1e-9 * message.clock.nanosec) / self.sample) % 2 == 0:
            super().answer(message)


def test_a_controller_with_another_period_is_named_with_both(capfd):
    with EveryOther(commands(), DT):
        run_robot(
            make_plant("model:ssm"),
            (0.0, 0.0, 0.0),
            settings(answer_timeout=0.05),
            load_sensor_set("default"),
            lock_step=True,
            duration=12 * DT,
        )
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "lock step: commands come" in line]
    assert "about every 40.4 ms, the robot's sample time is 20.2 ms" in line
    assert "--config FILE" in line


def test_commands_of_the_other_type_are_named_with_the_remedy(capfd):
    with Driver(commands(), DT, stamped=False):
        base = settings(stamped=True, answer_timeout=0.05)
        run_robot(make_plant("model:ssm"), (0.0, 0.0, 0.0), base, load_sensor_set("default"), duration=1.0)
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "listens to" in line]
    assert "driver publishes Twist on /cmd_vel, this robot listens to TwistStamped" in line
    assert "--unstamped, or set the node's parameter stamped:=true" in line


def test_a_silent_driver_lets_the_robot_stop(tmp_path):
    """It drives on for the command timeout, no longer, and comes to rest."""
    rows = np.tile([0.5, 0.0], (30, 1))
    driven(tmp_path / "bag", rows, ticks=100)
    speed = np.array([m.twist.linear.x for m in recorded(tmp_path / "bag", "/ground_truth/twist")[1]])
    last = recorded(tmp_path / "bag", "/cmd_vel")[0][-1]
    time = 1e-9 * (recorded(tmp_path / "bag", "/ground_truth/twist")[0] - last)
    assert np.all(speed[(time > 0.2) & (time < 0.5)] > 0.45)
    assert np.all(np.abs(speed[time > 1.3]) < 0.01)
    assert time[-1] > 1.3


def test_commands_that_cannot_be_meant_do_not_move_it(tmp_path):
    """NaN, and stamps of another clock."""
    bad, good = np.full((20, 2), np.nan), np.tile([0.5, 0.0], (20, 1))
    base = settings(answer_timeout=0.05)
    driven(tmp_path / "nan", bad, plant="model:ssm", base=base)
    driven(tmp_path / "ahead", good, plant="model:ssm", base=base, stamp=lambda now: now + 10**10)
    driven(tmp_path / "old", good, plant="model:ssm", base=base, stamp=lambda now: now - 10**9)
    for name in ("nan", "ahead", "old"):
        assert recorded(tmp_path / name, "/cmd_vel")[0].size
        truth = recorded_truth(tmp_path / name)
        assert np.array_equal(truth, np.tile(truth[0], (20, 1)))


def test_topics_carry_frames_and_rates(tmp_path):
    driver = driven(tmp_path / "bag", commands(), base=settings(**{"every.imu": 3}))
    odom, imu = recorded(tmp_path / "bag", "/odom")[1], recorded(tmp_path / "bag", "/imu")[1]
    assert (odom[0].header.frame_id, odom[0].child_frame_id) == ("odom", "base_link")
    assert recorded(tmp_path / "bag", "/pose")[1][0].header.frame_id == "map"
    assert len(odom) == TICKS and len(imu) == TICKS / 3
    assert np.all(np.diff(recorded(tmp_path / "bag", "/imu")[0]) == 3 * 20_200_000)
    assert imu[0].orientation_covariance[0] == -1.0
    # What went over the wire is what was recorded; a start is lost where the reader was not yet connected.
    sent = {message.header.stamp.nanosec: message.twist.twist.linear.x for message in odom}
    assert len(driver.odometry) > TICKS / 2
    assert all(sent[m.header.stamp.nanosec] == m.twist.twist.linear.x for m in driver.odometry)


@pytest.mark.parametrize(("source", "bound"), [("dead_reckoning", 0.03), ("pose_sensor", 0.03)])
def test_the_pose_in_odom_is_where_the_robot_is(tmp_path, source, bound):
    """Either way within centimetres after a curve of 1.2 s, at the instant of its stamp in spite of late poses."""
    rows = np.tile([0.8, 0.8], (TICKS, 1))
    driven(tmp_path / "bag", rows, base=settings(odometry_pose=source))
    poses = [message.pose.pose.position for message in recorded(tmp_path / "bag", "/odom")[1]]
    odom, truth = np.array([[p.x, p.y] for p in poses]), recorded_truth(tmp_path / "bag")[:, :2]
    assert np.abs(odom - truth).max() < bound
    assert np.linalg.norm(truth[-1] - truth[0]) > 0.5


def test_a_lost_robot_ends_the_run_and_the_bag_is_whole(tmp_path):
    plant = make_plant("model:ssm")
    advance, ticks = plant.advance, []

    def lose(command):
        ticks.append(command)
        if len(ticks) == 15:
            raise RobotLostError("t = 0.283 s: it is lost")
        advance(command)

    plant.advance = lose
    with Driver(commands(), DT), pytest.raises(RobotLostError, match="lost"):
        run_robot(plant, (0, 0, 0), settings(), load_sensor_set("default"), lock_step=True, record=tmp_path / "bag")
    assert len(recorded_truth(tmp_path / "bag")) == 15


def test_a_bag_is_never_written_over(tmp_path):
    with pytest.raises(ConfigError, match="is there already"):
        run_robot(make_plant("model:ssm"), (0, 0, 0), settings(), load_sensor_set("default"), record=tmp_path)


def test_settings_say_what_each_value_is():
    for schema in (BaseSettings, *(f.annotation for f in BaseSettings.model_fields.values())):
        for name, field in getattr(schema, "model_fields", {}).items():
            nested = hasattr(field.annotation, "model_fields")
            assert nested or field.description, name


START = (0.0, 0.0, 0.2)
ROOM = World(
    description="a wall ahead, a post to the left",
    time_limit=60.0,
    walls=[{"start": (2.0, -1.0), "end": (2.0, 1.0), "thickness": 0.2}],
    posts=[{"at": (0.0, 2.0), "radius": 0.5}],
    sight={"range_sd": 0.0, "latency": 0.06, "range": 3.0},
)


@pytest.fixture
def base(request, monkeypatch, tmp_path):
    """A robot on its topics, stepped by the test, in the world and with the settings that the test names."""
    ros_driver.own_domain(monkeypatch, tmp_path)
    world, changes = request.param
    plant = (
        make_plant("model:ssm", surface="ideal")
        if world == "none"
        else make_plant("mujoco", surface="default", world=world)
    )
    context = Context()
    rclpy.init(context=context, args=[])
    node = rclpy.create_node("simulated_robot", context=context)
    settings, clock = load_base_settings(changes=changes), SteppedClock(500, plant.sample_time)
    made = SimulatedBase(node, plant, START, settings, pose_memory=5, clock=clock)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    made.executor, made.clock = executor, clock
    yield made
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)


def drive(base, kind, topic, qos, command=(0.3, 0.4), ticks=60):
    """What arrived on a topic while the robot drove."""
    heard = []
    base.node.create_subscription(kind, topic, heard.append, qos)
    end = time.monotonic() + ros_driver.BOUND
    while not base.node.count_subscribers(topic) or base.executor.spin_once(timeout_sec=0.05):
        assert time.monotonic() < end
    for _ in range(ticks):
        now = base.clock.at(base.tick)
        base.inbox.put(*command, 0, now)
        base.publish_sensors(now, base.clock.origin)
        base.advance(now)
        for _ in range(4):
            base.executor.spin_once(timeout_sec=0.005)
    return heard


def matrix(transform):
    at, turn = transform.transform.translation, transform.transform.rotation
    yaw = 2.0 * math.atan2(turn.z, turn.w)
    return np.array([[math.cos(yaw), -math.sin(yaw), at.x], [math.sin(yaw), math.cos(yaw), at.y], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("base", [("none", {"transforms": "map", "frame_prefix": "r1/"})], indirect=True)
def test_the_chain_from_map_to_base_is_the_true_pose(ros_types, base):
    from tf2_msgs.msg import TFMessage

    truth = {}
    publish, advance = base.publish_sensors, base.advance

    def note(now, origin):
        truth[now] = base.plant.true_pose.copy()
        publish(now, origin)

    base.publish_sensors, base.advance = note, advance
    heard = drive(base, TFMessage, "/tf", 100)
    assert len(heard) > 30
    for message in heard:
        of = {(each.header.frame_id, each.child_frame_id): each for each in message.transforms}
        assert set(of) == {("r1/odom", "r1/base_link"), ("map", "r1/odom")}
        chain = matrix(of["map", "r1/odom"]) @ matrix(of["r1/odom", "r1/base_link"])
        true = truth[nanoseconds(message.transforms[0].header.stamp)]
        np.testing.assert_allclose(chain[:2, 2], true[:2], atol=1e-9)
        assert math.remainder(math.atan2(chain[1, 0], chain[0, 0]) - true[2], math.tau) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("base", [("doorway", {})], indirect=True)
def test_a_robot_in_a_world_sends_a_scan(base):
    heard = drive(base, LaserScan, "scan", qos_profile_sensor_data, command=(0.2, 0.0), ticks=50)
    assert 5 <= len(heard) <= 11
    scan = heard[-1]
    assert scan.header.frame_id == "base_link"
    assert len(scan.ranges) == round((scan.angle_max - scan.angle_min) / scan.angle_increment) + 1
    gaps = np.diff([nanoseconds(message.header.stamp) for message in heard])
    assert np.abs(gaps - 1e8).max() < 3e7
    assert np.isfinite(scan.ranges).any()


@pytest.mark.parametrize("base", [("none", {})], indirect=True)
def test_without_a_world_and_without_transforms_neither_is_there(base):
    names = {name for name, _ in base.node.get_publisher_names_and_types_by_node("simulated_robot", "/")}
    assert not names & {"/scan", "/tf"}


def test_ranges_are_those_of_the_world_and_arrive_late():
    scanner = Scanner(ROOM)
    assert scanner.look(0.0, (0.0, 0.0, 0.0), lambda t: round(1e9 * t)) is None
    assert scanner.look(0.05, (0.5, 0.0, 0.0), lambda t: round(1e9 * t)) is None
    scan = scanner.look(0.06, (0.5, 0.0, 0.0), lambda t: round(1e9 * t))
    assert nanoseconds(scan.header.stamp) == 0
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    ranges = np.array(scan.ranges)
    # From where it stood at the look: the wall's face at 1.9 m, the post's at 1.5 m.
    assert ranges[np.argmin(np.abs(angles))] == pytest.approx(1.9, abs=0.01)
    assert ranges[np.argmin(np.abs(angles - math.pi / 2))] == pytest.approx(1.5, abs=0.01)
    assert ranges[np.argmin(np.abs(angles + math.pi / 2))] == math.inf


def test_a_person_is_in_the_scan_where_it_walks():
    walking = ROOM.model_copy(
        update={"movers": (Mover(x=1.0, y=-0.5, direction=math.pi / 2, speed=0.5, radius=0.2),), "walls": ()}
    )
    scanner = Scanner(walking)
    scanner.look(0.0, (0.0, 0.0, 0.0), lambda t: 0)
    first = scanner.look(0.1, (0.0, 0.0, 0.0), lambda t: 0)
    later = [scanner.look(at, (0.0, 0.0, 0.0), lambda t: 0) for at in (1.0, 1.1)][-1]
    ahead = len(first.ranges) // 2
    assert first.ranges[ahead] == math.inf
    assert later.ranges[ahead] == pytest.approx(0.8, abs=0.01)


COMMAND = str(Path(sys.executable).with_name("diffdrive-mpc"))


@contextmanager
def started(*words, says):
    """The process, once it has said these words; it does not outlive the context, nor the bound."""
    robot = subprocess.Popen([COMMAND, "sim-robot", "--plant", "model:ssm", *words], stderr=subprocess.PIPE, text=True)
    watchdog = threading.Timer(BOUND, robot.kill)
    watchdog.start()
    try:
        assert any(says in line for line in robot.stderr), "it ended before it was ready"
        yield robot
    finally:
        watchdog.cancel()
        robot.kill()
        robot.wait()
        robot.stderr.close()


@pytest.mark.parametrize(
    ("number", "mode", "says"),
    [(signal.SIGINT, "--real-time", "ready, in real time"), (signal.SIGTERM, "--lock-step", "waiting for")],
)
def test_a_signal_ends_it_cleanly(number, mode, says, tmp_path):
    """Also in lock step with nobody there, where it waits."""
    with started(mode, "--record", str(tmp_path / "bag"), says=says) as robot:
        robot.send_signal(number)
        _, errors = robot.communicate()
    assert robot.returncode == 0, errors
    assert "Traceback" not in errors
    assert (tmp_path / "bag" / "metadata.yaml").exists()


@pytest.mark.long
def test_in_real_time_stamps_stand_on_the_samples(tmp_path):
    """However late the machine is: this much time is not given up here."""
    shipped = (Path(__file__).parents[2] / "sim" / "ros" / "base.yaml").read_text()
    base = tmp_path / "base.yaml"
    base.write_text(shipped.replace("most_behind: 0.2", "most_behind: 60"))
    words = ["--duration", "0.5", "--base", str(base), "--trajectory", "square", "--record", str(tmp_path / "bag")]
    before = time.time_ns()
    result = subprocess.run(
        [COMMAND, "sim-robot", "--plant", "model:ssm", *words],
        capture_output=True,
        text=True,
        timeout=BOUND,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    stamps, _ = recorded(tmp_path / "bag", "/odom")
    assert np.array_equal(np.diff(stamps), np.full(24, 20_200_000))
    assert before < stamps[0] < stamps[-1] < time.time_ns()
    assert np.array_equal(recorded_truth(tmp_path / "bag"), np.zeros((25, 3)))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--command-timeout", "0"], "base settings: command_timeout: Input should be greater than 0"),
        (["--duration", "0"], "--duration 0.0: give a time in seconds, more than zero"),
        (["--sed", "3"], "unknown argument '--sed'"),
        (["--surface", "lava"], "unknown surface 'lava'"),
        (["--ros-args", "--foo"], "ROS cannot start with the arguments '--ros-args --foo'"),
        (["--record", "."], "is there already"),
    ],
)
def test_bad_input_ends_in_one_line(words, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = invoke(app, "sim-robot", *words, code=2)
    assert line in result.stderr and result.stderr.count("\n") == 1


def test_it_ticks_at_the_period_of_the_node_s_configuration(tmp_path):
    (tmp_path / "slow.yaml").write_text("model: ssm\nsample_time: 0.05\n")
    words = ["--plant", "model:ssm", "--config", str(tmp_path / "slow.yaml"), "--record", str(tmp_path / "bag")]
    invoke(app, "sim-robot", *words, "--duration", "0.4")
    assert np.array_equal(np.diff(recorded(tmp_path / "bag", "/odom")[0]), np.full(7, 50_000_000))


def test_remapped_topics_and_namespaces_hold_in_the_bag(tmp_path):
    words = ["--duration", "0.1", "--record", str(tmp_path / "bag"), "--ros-args", "-r", "odom:=wheels/odom"]
    result = subprocess.run(
        [COMMAND, "sim-robot", "--plant", "model:ssm", *words, "-r", "__ns:=/one"],
        capture_output=True,
        text=True,
        timeout=BOUND,
        check=False,
        env=os.environ,
    )
    assert result.returncode == 0, result.stderr
    assert len(recorded(tmp_path / "bag", "/one/wheels/odom")[0]) == 5
