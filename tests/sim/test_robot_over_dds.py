"""Simulated robot over DDS: topics and process."""

import numpy as np
import pytest
from ros_driver import Driver, own_domain, read_messages, read_true_poses

from commands import invoke
from diffdrive_mpc import ConfigError, RobotLostError, make_plant
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.ros.run_robot import run_robot
from diffdrive_mpc.sim.ros.simulated_base import load_base_settings
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from studies.open_loop import drive_open_loop

pytestmark = pytest.mark.system

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


def record(bag, rows, *, plant="mujoco", seed=0, base=None, ticks=None, start=(1.0, 2.0, 0.5), storage="mcap", **opts):
    """Drive in lock step and record; return the driver."""
    base = base or settings()
    with Driver(rows, DT, stamped=base.stamped, **opts) as driver:
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
        record(tmp_path / name, rows, seed=3)
    log = drive_open_loop(make_plant("mujoco", seed=3), rows, (1.0, 2.0, 0.5))
    truth = read_true_poses(tmp_path / "one")
    assert np.array_equal(truth, read_true_poses(tmp_path / "two"))
    assert np.array_equal(truth[:, :2], log.true_pose[:, :2])
    assert np.allclose(truth[:, 2], log.true_pose[:, 2], rtol=0, atol=1e-14)
    assert np.ptp(truth[:, 0]) > 0.1
    stamps, _ = read_messages(tmp_path / "one", "/ground_truth/pose")
    assert np.array_equal(np.diff(stamps), np.full(TICKS - 1, 20_200_000))


@pytest.mark.parametrize(("stamped", "storage"), [(True, "mcap"), (False, "sqlite3")])
def test_recording_equals_the_log_of_the_drive(tmp_path, stamped, storage):
    """`read_log` returns the commands, encoders, gyro and poses of the same drive without ROS."""
    rows = commands(200, seed=1)
    record(tmp_path / "bag", rows, seed=2, base=settings(stamped=stamped), storage=storage)
    log = drive_open_loop(make_plant("mujoco", seed=2), rows, (1.0, 2.0, 0.5))
    (drive,) = read_log(tmp_path / "bag", "simulated_robot").records
    assert drive.dt == pytest.approx(DT, abs=1e-12)
    assert np.array_equal(drive.command, log.command)
    assert np.allclose(drive.twist, log.wheel_twist, rtol=0, atol=1e-9)
    assert np.allclose(drive.yaw_rate, log.yaw_rate, rtol=0, atol=1e-9)
    plant = make_plant("mujoco", seed=2)
    plant.reset((1.0, 2.0, 0.5))
    readings = []
    for row in rows:
        readings.append(plant.measure().pose)
        plant.advance(row)
    stamps, poses = read_messages(tmp_path / "bag", "/pose")
    assert np.array_equal(stamps - stamps[0], [round(1e9 * (p.time - readings[0].time)) for p in readings])
    assert [p.pose.pose.position.x for p in poses] == [p.value[0] for p in readings]
    assert poses[0].pose.covariance[0] == readings[0].covariance[0][0]


def test_robot_stops_without_commands(tmp_path):
    """The robot continues until the command timeout, then comes to rest."""
    rows = np.tile([0.5, 0.0], (30, 1))
    record(tmp_path / "bag", rows, ticks=100)
    speed = np.array([m.twist.linear.x for m in read_messages(tmp_path / "bag", "/ground_truth/twist")[1]])
    last = read_messages(tmp_path / "bag", "/cmd_vel")[0][-1]
    time = 1e-9 * (read_messages(tmp_path / "bag", "/ground_truth/twist")[0] - last)
    assert np.all(speed[(time > 0.2) & (time < 0.5)] > 0.45)
    assert np.all(np.abs(speed[time > 1.3]) < 0.01)
    assert time[-1] > 1.3


def test_invalid_commands_do_not_move_the_robot(tmp_path):
    """The commands contain NaN, or stamps of another clock."""
    nan_commands, valid_commands = np.full((20, 2), np.nan), np.tile([0.5, 0.0], (20, 1))
    base = settings(answer_timeout=0.05)
    record(tmp_path / "nan", nan_commands, plant="model:ssm", base=base)
    record(tmp_path / "ahead", valid_commands, plant="model:ssm", base=base, stamp=lambda now: now + 10**10)
    record(tmp_path / "old", valid_commands, plant="model:ssm", base=base, stamp=lambda now: now - 10**9)
    for name in ("nan", "ahead", "old"):
        assert read_messages(tmp_path / name, "/cmd_vel")[0].size
        truth = read_true_poses(tmp_path / name)
        assert np.array_equal(truth, np.tile(truth[0], (20, 1)))


def test_topics_have_their_frames_and_rates(tmp_path):
    driver = record(tmp_path / "bag", commands(), base=settings(**{"every.imu": 3}))
    odom, imu = read_messages(tmp_path / "bag", "/odom")[1], read_messages(tmp_path / "bag", "/imu")[1]
    assert (odom[0].header.frame_id, odom[0].child_frame_id) == ("odom", "base_link")
    assert read_messages(tmp_path / "bag", "/pose")[1][0].header.frame_id == "map"
    assert len(odom) == TICKS and len(imu) == TICKS / 3
    assert np.all(np.diff(read_messages(tmp_path / "bag", "/imu")[0]) == 3 * 20_200_000)
    assert imu[0].orientation_covariance[0] == -1.0
    # Received and recorded messages are equal; the driver may miss messages before it is connected.
    recorded = {message.header.stamp.nanosec: message.twist.twist.linear.x for message in odom}
    assert len(driver.odometry) > TICKS / 2
    assert all(recorded[m.header.stamp.nanosec] == m.twist.twist.linear.x for m in driver.odometry)


@pytest.mark.parametrize(("source", "bound"), [("dead_reckoning", 0.03), ("pose_sensor", 0.03)])
def test_pose_in_odom_is_near_the_true_pose(tmp_path, source, bound):
    """Errors are centimetres after a curve of 1.2 s, at the time of the stamp despite late poses."""
    rows = np.tile([0.8, 0.8], (TICKS, 1))
    record(tmp_path / "bag", rows, base=settings(odometry_pose=source))
    poses = [message.pose.pose.position for message in read_messages(tmp_path / "bag", "/odom")[1]]
    odom, truth = np.array([[p.x, p.y] for p in poses]), read_true_poses(tmp_path / "bag")[:, :2]
    assert np.abs(odom - truth).max() < bound
    assert np.linalg.norm(truth[-1] - truth[0]) > 0.5


def test_lost_robot_ends_the_run_with_a_complete_bag(tmp_path):
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
    assert len(read_true_poses(tmp_path / "bag")) == 15


def test_existing_bag_is_not_overwritten(tmp_path):
    with pytest.raises(ConfigError, match="already exists"):
        run_robot(make_plant("model:ssm"), (0, 0, 0), settings(), load_sensor_set("default"), record=tmp_path)


def test_robot_ticks_at_the_sample_time_of_the_configuration(tmp_path):
    (tmp_path / "slow.yaml").write_text("model: ssm\nsample_time: 0.05\n")
    arguments = ["--plant", "model:ssm", "--config", str(tmp_path / "slow.yaml"), "--record", str(tmp_path / "bag")]
    invoke(app, "sim-robot", *arguments, "--duration", "0.4")
    assert np.array_equal(np.diff(read_messages(tmp_path / "bag", "/odom")[0]), np.full(7, 50_000_000))


def test_robot_of_a_configuration_corrects_its_odometry_and_notes_another_plant(tmp_path, monkeypatch):
    corrections = []
    monkeypatch.setattr(
        "diffdrive_mpc.sim.ros.run_robot.run_robot",
        lambda *_, correction, **__: corrections.append(correction),
    )
    (tmp_path / "fast.yaml").write_text("model: ssm\nlimits: {v: 3.0}\nsensors: {yaw_rate: {sign: -1}}\n")
    result = invoke(app, "sim-robot", "--config", str(tmp_path / "fast.yaml"))
    assert corrections == [(1.0, -1.0)]
    assert "note: the plant 'mujoco' does not match the robot of the configuration" in result.output


def test_driver_of_a_robot_slower_than_its_trajectory_is_a_command_that_the_node_accepts(tmp_path, monkeypatch):
    drivers = []
    monkeypatch.setattr("diffdrive_mpc.sim.ros.run_robot.run_robot", lambda *_, driver, **__: drivers.append(driver))
    (tmp_path / "slow.yaml").write_text("model: ssm\nlimits: {v: 0.3}\n")
    result = invoke(app, "sim-robot", "--plant", "model:ssm", "--config", str(tmp_path / "slow.yaml"))
    assert "--trajectory FILE --drive" in drivers[0]
    assert "note: the node refuses this trajectory: " in result.output
