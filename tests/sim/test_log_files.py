"""Logs of runs as MCAP and CSV: read values equal the written values."""

import json
import os
import stat
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from log_parts import read_columns
from loop_parts import ConstantTwist, FeedForward, KinematicPlant
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from commands import invoke
from diffdrive_mpc import ConfigError, Controller, Measurement, Stamped, load_config, load_trajectory, make_plant
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.drive_log.reader import is_drive_log, read_drive_log
from diffdrive_mpc.models.logs.drive_log.tick import tick_schema
from diffdrive_mpc.models.logs.drive_log.topics import KINDS, STATE
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim import Run, log_csv, log_mcap, simulate

STORE = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture(scope="module")
def run():
    plant = make_plant("model:ssm", sensors="slam", seed=2)
    return simulate(Controller(load_config("ssm")), plant, load_trajectory("s"), keep_plans=True)


@pytest.fixture(scope="module")
def file(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "s.mcap"
    log_mcap.write_log(run, path, {"case": {"model": "ssm"}})
    return path


def messages(path):
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            yield channel.topic, schema, channel, message


def messages_on(path, topic):
    """Return (log time [ns], message) of one topic."""
    schema = KINDS[topic]
    return [(m.log_time, STORE.deserialize_cdr(m.data, schema)) for name, *_, m in messages(path) if name == topic]


def is_equal(first, second):
    return np.array_equal(first, second) if first.dtype == object else np.array_equal(first, second, equal_nan=True)


def test_mcap_library_reads_every_column_bit_for_bit(run, file):
    rows = [json.loads(message.data) for topic, *_, message in messages(file) if topic == STATE]
    for name, column in run.columns.items():
        missing = "" if column.dtype == object else np.nan
        assert is_equal(np.array([row.get(name, missing) for row in rows], dtype=column.dtype), column), name


def test_log_reader_returns_columns_measurements_and_plans(run, file):
    log = read_drive_log(file, plans=True)
    columns = log.columns
    assert all(is_equal(columns[name], column) for name, column in run.columns.items())
    for actual, expected in zip(log.measurements, run.measurements, strict=True):
        for name in ("pose", "wheel_twist", "yaw_rate"):
            first, second = getattr(actual, name), getattr(expected, name)
            assert (first is None) == (second is None)
            if first is not None:
                assert first.time == second.time and np.array_equal(first.value, second.value)
                assert np.array_equal(first.covariance, second.covariance)
    plans = np.array(log.plans)
    assert np.array_equal(plans[..., :2], run.plans[..., :2])
    assert np.allclose(np.sin(0.5 * (plans - run.plans)[..., 2]), 0.0, atol=1e-12)
    assert log.metadata["case"] == {"model": "ssm"} and log.metadata["run"]["trajectory"] == "s"


def test_every_row_matches_its_schema_which_contains_every_column(run, file):
    schemas = {topic: schema for topic, schema, *_ in messages(file)}
    row_schema = json.loads(schemas[STATE].data)
    assert schemas[STATE].encoding == "jsonschema" and row_schema == tick_schema()
    assert set(run.columns) <= set(row_schema["properties"])
    check = Draft202012Validator(row_schema | {"additionalProperties": False})
    for topic, *_, message in messages(file):
        if topic == STATE:
            check.validate(json.loads(message.data))


def test_ros_topics_contain_the_same_values_and_their_definitions(run, file):
    for topic, schema, channel, _ in messages(file):
        if topic != STATE:
            assert (schema.name, schema.encoding, channel.message_encoding) == (KINDS[topic], "ros2msg", "cdr")
            assert schema.data.decode() == STORE.generate_msgdef(schema.name, ros_version=2)[0]
    commands = [(m.twist.linear.x, m.twist.angular.z) for _, m in messages_on(file, "/cmd_vel")]
    assert np.array_equal(commands, run.command)
    seconds = np.array([now for now, _ in messages_on(file, "/cmd_vel")]) * 1e-9
    assert np.allclose(seconds - 1.0, run.time, atol=1e-9)
    has_pose = np.isfinite(run.measured_pose).all(axis=1)
    poses = [m for _, m in messages_on(file, "/pose")]
    assert np.array_equal(
        [(m.pose.pose.position.x, m.pose.pose.position.y) for m in poses], run.measured_pose[has_pose, :2]
    )
    stamps = np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in poses])
    assert np.allclose(stamps - 1.0, run.measured_pose_time[has_pose], atol=1e-9)
    truth = [m.pose.position.x for _, m in messages_on(file, "/ground_truth/pose")]
    assert np.array_equal(truth, run.true_pose[:, 0])
    assert next(m.data for _, m in messages_on(file, "/diffdrive_mpc/mode")) == run.modes[0]
    (path,) = [m for _, m in messages_on(file, "/diffdrive_mpc/reference_path")]
    assert np.allclose(path.poses[-1].pose.position.x, run.reference.sample([run.reference.duration]).pose[0, 0])


def test_odometry_in_a_log_is_corrected_as_the_configuration_states(tmp_path):
    arguments = ["--set", "sensors.yaw_rate.sign=-1", "--trajectory", "cane", "--log", str(tmp_path / "cane.mcap")]
    invoke(app, "simulate", *arguments)
    last = [messages_on(tmp_path / "cane.mcap", topic)[-1][1].pose for topic in ("/odom", "/ground_truth/pose")]
    (x, y), (true_x, true_y) = ((p.position.x, p.position.y) for p in (last[0].pose, last[1]))
    assert np.hypot(x - true_x, y - true_y) < 0.1


def test_mcap_and_csv_logs_give_equal_records(run, file, tmp_path):
    log_csv.write_log(run, tmp_path / "s.csv")
    mcap, csv = read_log(file), read_log(tmp_path / "s.csv")
    assert [finding.kind for finding in mcap.findings] == [finding.kind for finding in csv.findings]
    for first, second in zip(mcap.records, csv.records, strict=True):
        for field in fields(first):
            a, b = getattr(first, field.name), getattr(second, field.name)
            assert np.array_equal(a, b, equal_nan=True) if isinstance(a, np.ndarray) else a == b or field.name == "name"


def test_truncated_file_is_read_up_to_its_end(run, file, tmp_path):
    truncated = tmp_path / "cut.mcap"
    truncated.write_bytes(file.read_bytes()[: int(0.8 * file.stat().st_size)])
    log = read_drive_log(truncated)
    count = len(log.rows)
    assert log.cut and 0.5 * len(run.time) < count < len(run.time)
    assert np.array_equal(log.columns["t_s"], run.time[:count])
    partial = read_log(truncated)
    assert [(finding.kind, finding.severity) for finding in partial.findings] == [("cut file", "note")]
    assert "mcap recover" in str(partial.findings[0])


def test_bag_of_another_recorder_is_not_read_as_a_drive(tmp_path):
    from log_parts import bag_topics, drive, write_bag

    bag = write_bag(tmp_path / "bag", bag_topics(drive(seconds=6.0)), "mcap")
    assert not is_drive_log(bag / "bag.mcap")
    with pytest.raises(ConfigError, match="contains no tick"):
        read_drive_log(bag / "bag.mcap")
    with Reader(bag / "bag.mcap") as reader:
        assert reader.connections


class SparsePlant(KinematicPlant):
    """Plant with poses only every fifth tick, one tick late, and four wheel speeds."""

    def measure(self) -> Measurement:
        full = super().measure()
        tick = round(self.time / self.sample_time)
        pose = Stamped(full.pose.value, full.pose.time - 0.02) if full.pose and tick % 5 == 0 else None
        return Measurement(pose, None, full.yaw_rate, Stamped(self.time + np.arange(4.0), self.time))


@pytest.fixture
def sparse_run() -> Run:
    return simulate(FeedForward(), SparsePlant(0.01, seed=1), ConstantTwist(0.3, 0.7, 1.0))


def test_columns_of_a_csv_log_are_equal_bit_for_bit(sparse_run: Run, tmp_path: Path) -> None:
    log_csv.write_log(sparse_run, tmp_path / "run.csv")
    log = read_columns(tmp_path / "run.csv")
    assert tuple(log) == tuple(sparse_run.columns)
    assert all(is_equal(np.array(log[name], dtype=column.dtype), column) for name, column in sparse_run.columns.items())
    assert np.isfinite(sparse_run.measured_pose[:, 0]).sum() == 11
    assert log["pose_t_s"][5] == pytest.approx(0.08)


def test_log_replaces_a_file_and_preserves_its_permissions(sparse_run: Run, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    log_csv.write_log(sparse_run, path)
    path.chmod(0o640)
    log_csv.write_log(sparse_run, path)
    assert read_columns(path)["t_s"].size == sparse_run.time.size
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


@pytest.mark.parametrize("write", [log_csv.write_log, log_mcap.write_log])
def test_file_of_another_kind_is_not_replaced(sparse_run: Run, tmp_path: Path, write: Callable[..., None]) -> None:
    path = tmp_path / "run"
    path.write_text("other")
    with pytest.raises(ConfigError, match=r"run: the file exists and is of another kind; give another name"):
        write(sparse_run, path)
    assert path.read_text() == "other"


@pytest.mark.parametrize("create", [Path.mkdir, os.mkfifo, lambda path: path.symlink_to("/dev/null")])
def test_only_a_regular_file_is_replaced(sparse_run: Run, tmp_path: Path, create: Callable[[Path], None]) -> None:
    path = tmp_path / "run.csv"
    create(path)
    original = path.lstat()
    with pytest.raises(ConfigError, match=r"run\.csv: not a regular file"):
        log_csv.write_log(sparse_run, path)
    assert path.lstat() == original
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.csv"]


def test_failure_leaves_the_old_file_and_no_new_folder(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("old")
    for path in (tmp_path / "run.csv", tmp_path / "new" / "folder" / "run.csv"):
        with pytest.raises(ZeroDivisionError), whole_file(path) as draft:
            draft.write_text("half")
            raise ZeroDivisionError
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.csv"]
    assert (tmp_path / "run.csv").read_text() == "old"
