"""Reader of ROS 2 bags in both storage formats: contents, clocks, and malicious files."""

import os
import shutil
import sqlite3
import struct
import tracemalloc
from dataclasses import fields, replace
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import yaml
import zstandard
from log_parts import BAG_START, bag_topics, drive, message, teleoperated, write_bag, write_mapping
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from diffdrive_mpc import ConfigError
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.logs import read_log, sqlite_file
from diffdrive_mpc.models.logs.bag_bounds import MAX_UNPACKED, unpack
from diffdrive_mpc.models.logs.bag_topics import open_bag
from diffdrive_mpc.models.logs.drive_log.reader import is_drive_log, read_drive_log
from diffdrive_mpc.models.logs.record import MappingChange
from refusals import one_line_error

COLUMNS = drive(seconds=6.0)
TOPICS = "topics:\n  command: /cmd_vel\n  odometry: /odom\n  imu: /imu\n  pose: /pose\n"


def records_are_equal(first, second):
    pairs = [(getattr(first, field.name), getattr(second, field.name)) for field in fields(first)]
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs if isinstance(a, np.ndarray))


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("command", ["geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"])
@pytest.mark.parametrize("pose", ["geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"])
def test_record_of_a_bag_equals_that_of_a_csv_log(tmp_path, storage, command, pose):
    """Times are the stamps, not the times of receipt; the pose of the odometry is not used."""
    bag = write_bag(tmp_path / "bag", bag_topics(COLUMNS, command, pose), storage)
    log = read_log(bag, write_mapping(tmp_path / "topics.yaml", TOPICS))
    (record,) = log.records
    assert record.dt == 0.02
    assert log.findings == ()
    assert np.array_equal(record.command, np.column_stack([COLUMNS["v_ref"], COLUMNS["omega_ref"]]))
    assert np.array_equal(record.twist, np.column_stack([COLUMNS["v"], COLUMNS["omega_wheels"]]))
    assert np.array_equal(record.yaw_rate, COLUMNS["gyro"])
    assert np.array_equal(np.flatnonzero(record.fresh_pose), np.arange(0, 300, 5))
    measured = np.column_stack([COLUMNS[name] for name in ("x", "y", "theta")])
    assert np.allclose(record.pose[record.fresh_pose], measured[::5], atol=1e-12)


@pytest.mark.parametrize(
    ("mounts", "axis"),
    [
        ([("body", "base_link", np.pi)], (-1, 0, 0)),
        ([("body", "base_link", np.pi / 2)], (0, np.nan, 1)),
        ([("body", "mast", np.pi / 2), ("mast", "base_link", np.pi / 2)], (-1, 0, 0)),
        ([("body", "base_link", np.pi / 6)], (np.cos(np.pi / 6), 0, np.sin(np.pi / 6))),
    ],
)
def test_gyro_of_a_bag_is_read_about_the_vertical_of_tf_static(tmp_path, mounts, axis):
    """The gyro is mounted upside down, on its side, upside down by two transforms, or tilted."""
    topics = bag_topics(COLUMNS)
    topics["/imu"] = (*topics["/imu"][:3], np.outer(COLUMNS["gyro"], axis))
    topics["/tf_static"] = ("tf2_msgs/msg/TFMessage", [0.0] * len(mounts), [0.0] * len(mounts), mounts)
    (record,) = read_log(write_bag(tmp_path / "bag", topics)).records
    assert np.allclose(record.yaw_rate, COLUMNS["gyro"], atol=1e-12)


def test_stated_sign_of_a_gyro_replaces_tf_static(tmp_path):
    """The sign is not applied twice. The node also ignores the transforms in this case."""
    topics = bag_topics({**COLUMNS, "gyro": -COLUMNS["gyro"]})
    topics["/tf_static"] = ("tf2_msgs/msg/TFMessage", [0.0], [0.0], [("body", "base_link", np.pi)])
    mapping = write_mapping(tmp_path / "map.yaml", "topics: {odometry: /odom, imu: {topic: /imu, sign: -1}}\n")
    (record,) = read_log(write_bag(tmp_path / "bag", topics), mapping).records
    assert np.array_equal(record.yaw_rate, COLUMNS["gyro"])


def test_default_topics_are_read_without_a_mapping(tmp_path):
    bag = write_bag(tmp_path / "bag", bag_topics(COLUMNS), "mcap")
    (bag_record,) = read_log(bag).records
    (file_record,) = read_log(bag / "bag.mcap").records
    assert bag_record.pose is None and bag_record.twist is not None and bag_record.yaw_rate is not None
    assert records_are_equal(bag_record, file_record)


def test_signs_and_delays_of_topics_are_applied(tmp_path):
    bag = write_bag(tmp_path / "bag", bag_topics(COLUMNS))
    mapping = "topics:\n  imu: {topic: /imu, sign: -1, delay: 0.1}\n  odometry: /odom\n"
    (record,) = read_log(bag, write_mapping(tmp_path / "topics.yaml", mapping)).records
    assert np.allclose(record.yaw_rate[:295], -COLUMNS["gyro"][5:300], atol=1e-12)


def test_finding_in_a_bag_names_the_key_of_its_mapping(tmp_path):
    bag = write_bag(tmp_path / "bag", bag_topics({**COLUMNS, "gyro": -COLUMNS["gyro"]}))
    assert any(str(finding).endswith("in the mapping: imu `sign: -1`") for finding in read_log(bag).findings)


def altered_bag(folder, topic, change):
    """Write the bag of the drive with other times of receipt, stamps and readings of a topic."""
    topics = bag_topics(COLUMNS)
    kind, *arrays = topics[topic]
    return write_bag(folder / "bag", topics | {topic: (kind, *change(*arrays))})


def test_unset_stamps_fall_back_to_the_times_of_receipt(tmp_path):
    bag = altered_bag(tmp_path, "/imu", lambda received, stamped, readings: (received, 0 * stamped - 1.7e9, readings))
    log = read_log(bag)
    (finding,) = log.findings
    assert str(finding) == "bag, /imu: not every message has a stamp; the times of receipt are used"


def test_two_clocks_are_an_error_with_a_remedy(tmp_path):
    bag = altered_bag(tmp_path, "/imu", lambda received, stamped, readings: (received, stamped - 1000.0, readings))
    message = "two clocks: the times of /cmd_vel are 1000.007 s ahead of those of /imu; set"
    with pytest.raises(ConfigError, match=message):
        read_log(bag)
    mapping = TOPICS + "  clock: receive\n"
    (record,) = read_log(bag, write_mapping(tmp_path / "topics.yaml", mapping)).records
    assert record.yaw_rate is not None


def test_drifting_clock_is_a_finding(tmp_path):
    bag = altered_bag(tmp_path, "/imu", lambda received, *rest: (received + 0.1 * (received - received[0]), *rest))
    findings = read_log(bag).findings
    assert any(finding.kind == "clock drift" and "/imu" in finding.place for finding in findings)


def test_messages_out_of_order_or_not_finite_are_omitted(tmp_path):
    def corrupt(received, stamped, readings):
        stamped, readings = stamped.copy(), readings.copy()
        stamped[50], readings[70] = stamped[40], np.inf
        return received, stamped, readings

    log = read_log(altered_bag(tmp_path, "/imu", corrupt))
    assert [str(finding) for finding in log.findings] == [
        "bag, /imu, message 71: 1 messages are not finite and are left out",
        "bag, /imu, message 51: 1 messages are not later than an earlier message and are left out",
    ]
    assert list(np.flatnonzero(~log.records[0].fresh_yaw_rate)) == [50, 70]


def select_topics(topics, *names):
    return {name: topics[name] for name in names}


DRAFTED = r"drafted by `.*-mapping`; the bag has /imu"
TWO_MISTAKES = r"2 mistakes: \(1\) no topics '/cmd', '/slam'; name them under .*; \(2\) topic '/imu' is of type "
NO_COMMAND = r"neither /odom nor /imu is in the bag, nor is the command /cmd_vel.*--draft-mapping`; the bag has /pose"
NO_TOPICS = "columns: {time: t, command: {v: v, omega: w}, gyro: {yaw_rate: g}}"


@pytest.mark.parametrize(
    ("names", "mapping", "message"),
    [
        (("/odom", "/imu"), None, f"no topic '/cmd_vel'; name it under 'topics' in a mapping, {DRAFTED}"),
        (("/cmd_vel", "/imu"), "topics: {command: /cmd, odometry: /imu, pose: /slam}", TWO_MISTAKES),
        (("/cmd_vel", "/imu"), NO_TOPICS, "the mapping has no 'topics'"),
        (("/pose",), None, NO_COMMAND),
    ],
)
def test_missing_or_wrong_topic_raises_error_in_one_line(tmp_path, names, mapping, message):
    bag = write_bag(tmp_path / "bag", select_topics(bag_topics(COLUMNS), *names))
    mapping_file = None if mapping is None else write_mapping(tmp_path / "map.yaml", mapping)
    with one_line_error(ConfigError, match=message):
        read_log(bag, mapping_file)


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def overwrite_middle(path):
    data = bytearray(path.read_bytes())
    third = len(data) // 3
    data[third : 2 * third] = bytes(range(256)) * (third // 256) + bytes(third % 256)
    path.write_bytes(data)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("damage", [truncate, overwrite_middle, lambda path: path.write_bytes(b"no bag")])
def test_damaged_bag_raises_error_in_one_line(tmp_path, storage, damage):
    bag = write_bag(tmp_path / "bag", bag_topics(COLUMNS), storage)
    file = bag / {"sqlite3": "bag.db3", "mcap": "bag.mcap"}[storage]
    damage(file)
    for path in (bag, file):
        with one_line_error(ConfigError, "cannot be read as a ROS 2 bag"):
            read_log(path)


def test_definitions_inside_a_bag_are_not_used(tmp_path):
    """The library would generate code from a definition, so an invalid definition must have no effect."""
    bag = write_bag(tmp_path / "bag", bag_topics(COLUMNS))
    (original,) = read_log(bag).records
    shutil.copytree(bag, tmp_path / "changed")
    with sqlite3.connect(tmp_path / "changed" / "bag.db3") as database:
        database.execute("UPDATE message_definitions SET encoded_message_definition = 'import os\nfloat64 x)=('")
    (record,) = read_log(tmp_path / "changed").records
    assert records_are_equal(original, record)


def test_commands_sent_on_change_are_held(tmp_path):
    bag = altered_bag(tmp_path, "/cmd_vel", lambda *arrays: [array[::25] for array in arrays])  # one row per change
    text = "topics: {command: {topic: /cmd_vel, on_change: true}, odometry: /odom, imu: /imu}\n"
    (record,) = read_log(bag, write_mapping(tmp_path / "map.yaml", text)).records
    assert record.dt == pytest.approx(0.02)
    expected = np.column_stack([COLUMNS["v_ref"], COLUMNS["omega_ref"]])
    assert np.array_equal(record.command, expected[: len(record.command)])


ON_CHANGE = "topics: {command: {topic: /cmd_vel, on_change: true}, odometry: /odom}\n"


@pytest.mark.parametrize(("seed", "sensor_dt"), [(1, 1 / 30), (2, 0.04)])
def test_commands_in_bursts_give_a_finding_with_the_mapping_that_uses_the_whole_log(tmp_path, seed, sensor_dt):
    path = write_bag(tmp_path / "bag", teleoperated(seconds=40.0, seed=seed, sensor_dt=sensor_dt))
    log = read_log(path)
    (finding,) = [finding for finding in log.findings if finding.kind == "silent commands"]
    assert "bag, /cmd_vel: commands arrive in bursts; 23 silences" in str(finding)
    assert finding.changes == (MappingChange("command", "on_change", True),)
    assert log.records[0].dt == pytest.approx(sensor_dt, rel=1e-4)
    assert sum(record.end - record.start for record in log.records) < 20.0
    complete_log = read_log(path, write_mapping(tmp_path / "map.yaml", ON_CHANGE))
    (record,) = complete_log.records
    assert record.end - record.start > 38.0
    assert complete_log.findings == ()


def test_ros_1_bag_is_refused_with_the_conversion_command(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(tmp_path / "drive.bag") as writer:
        writer.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=store)
    with pytest.raises(ConfigError, match="convert it: `rosbags-convert --src drive.bag --dst drive`"):
        read_log(tmp_path / "drive.bag")


def test_custom_message_is_read_with_its_definition(tmp_path):
    (tmp_path / "Speeds.msg").write_text("std_msgs/Header header\nfloat64 forward\nfloat64 turning\n")
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg((tmp_path / "Speeds.msg").read_text(), "mine/msg/Speeds"))
    with Writer(tmp_path / "bag", version=9) as writer:
        commands = writer.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=store)
        speeds = writer.add_connection("/speeds", "mine/msg/Speeds", typestore=store)
        for k, log_time in enumerate(COLUMNS["t"]):
            nanoseconds = round((BAG_START + log_time) * 1e9)
            command = (COLUMNS["v_ref"][k], COLUMNS["omega_ref"][k])
            twist = store.serialize_cdr(
                message("geometry_msgs/msg/Twist", command, log_time), "geometry_msgs/msg/Twist"
            )
            writer.write(commands, nanoseconds, twist)
            stamp = store.types["builtin_interfaces/msg/Time"](nanoseconds // 10**9, nanoseconds % 10**9)
            header = store.types["std_msgs/msg/Header"](stamp, "base_link")
            speed = store.types["mine/msg/Speeds"](header, COLUMNS["v"][k], COLUMNS["omega_wheels"][k])
            writer.write(speeds, nanoseconds, store.serialize_cdr(speed, "mine/msg/Speeds"))
    text = "topics:\n  odometry: {topic: /speeds, fields: [forward, turning]}\n"
    with pytest.raises(ConfigError, match="give their .msg file under 'definitions'"):
        read_log(tmp_path / "bag", write_mapping(tmp_path / "map.yaml", text))
    text += "  definitions: {mine/msg/Speeds: Speeds.msg}\n"
    (record,) = read_log(tmp_path / "bag", write_mapping(tmp_path / "map.yaml", text)).records
    assert np.array_equal(record.twist[:, 1], COLUMNS["omega_wheels"][: len(record.twist)])


# Malicious MCAP files.

MAGIC = b"\x89MCAP0\r\n"


def mcap_text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def mcap_record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def mcap_message(content: bytes) -> bytes:
    return mcap_record(5, struct.pack("<HIQQ", 1, 0, 5, 5) + content)


def mcap_topic(name: str) -> bytes:
    texts = [mcap_text(text) for text in ("geometry_msgs/msg/Twist", "ros2msg", "", name, "cdr", "")]
    schema = mcap_record(3, struct.pack("<H", 1) + b"".join(texts[:3]))
    return schema + mcap_record(4, struct.pack("<HH", 1, 1) + b"".join(texts[3:]))


def mcap_chunk(packed: bytes, compression: str, size: int) -> bytes:
    head = struct.pack("<QQQI", 0, 10, size, 0) + mcap_text(compression)
    return mcap_record(6, head + struct.pack("<Q", len(packed)) + packed)


def zeros(megabytes: int, compression: str) -> bytes:
    """Return packed zeros."""
    packer = lz4.frame.LZ4FrameCompressor() if compression == "lz4" else zstandard.ZstdCompressor().compressobj()
    first = packer.begin() if compression == "lz4" else b""
    return first + b"".join(packer.compress(bytes(10**6)) for _ in range(megabytes)) + packer.flush()


HEAD = MAGIC + mcap_record(1, mcap_text("ros2") + mcap_text("test")) + mcap_topic("/cmd_vel")
ZSTD = mcap_text("zstd")


def _footer(summary: int = 0) -> bytes:
    return mcap_record(2, struct.pack("<QQI", summary, 0, 0)) + MAGIC


def _write_mcap(path: Path, body: bytes) -> Path:
    path.write_bytes(HEAD + body + _footer())
    return path


def _write_indexed(path: Path, chunks: list[bytes], repeats: int = 1) -> Path:
    """Write a file whose index lists each chunk `repeats` times."""
    body, index = HEAD, b""
    for chunk in chunks:
        size = struct.unpack("<Q", chunk[25:33])[0]
        offsets = struct.pack("<I", 10) + struct.pack("<HQ", 1, len(body) + len(chunk))
        entry = struct.pack("<QQQQ", 0, 10, len(body), len(chunk))
        index += mcap_record(8, entry + offsets + struct.pack("<Q", 31) + ZSTD + struct.pack("<QQ", 0, size))
        body += chunk
    body += mcap_record(15, bytes(4))
    path.write_bytes(body + mcap_topic("/cmd_vel") + index * repeats + _footer(len(body)))
    return path


def _refusal(path: Path) -> str:
    """Return the error message of a refused bag; check that memory use is at most 2.2 times the chunk limit."""
    tracemalloc.start()
    try:
        with one_line_error(ConfigError, path.name) as error:
            read_log(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2.2 * MAX_UNPACKED, peak
    return str(error.value)


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("stated_size", [1_000, 400_000_000])
def test_decompression_bomb_is_refused_for_any_stated_size(tmp_path: Path, compression: str, stated_size: int) -> None:
    """400 MB are compressed to a few kilobytes."""
    path = _write_mcap(tmp_path / "bomb.mcap", mcap_chunk(zeros(400, compression), compression, stated_size))
    assert "chunk" in _refusal(path)


def test_total_size_of_the_chunks_is_limited(tmp_path: Path) -> None:
    """Each chunk is small, but their sum is much larger than the file."""
    content = mcap_message(bytes(1_000_000))
    packed = zstandard.ZstdCompressor().compress(content)
    path = _write_mcap(tmp_path / "many.mcap", mcap_chunk(packed, "zstd", len(content)) * 40)
    assert "100 times its size" in _refusal(path)


def test_overlapping_chunks_are_not_all_in_memory(tmp_path: Path) -> None:
    """Random data prevent a high compression ratio."""
    content = mcap_message(os.urandom(700_000) + bytes(40_000_000))
    packed = zstandard.ZstdCompressor().compress(content)
    path = _write_indexed(tmp_path / "overlap.mcap", [mcap_chunk(packed, "zstd", len(content))] * 4)
    assert "neither /odom nor /imu" in _refusal(path)


def test_chunk_that_is_indexed_repeatedly_is_read_once(tmp_path: Path) -> None:
    content = mcap_message(b"")
    chunk = mcap_chunk(zstandard.ZstdCompressor().compress(content), "zstd", len(content))
    with open_bag(_write_indexed(tmp_path / "again.mcap", [chunk], repeats=3)) as reader:
        assert reader.connections == [("/cmd_vel", "geometry_msgs/msg/Twist", 1)]


@pytest.mark.parametrize("length", [3_000_000_000, 2**60])
@pytest.mark.parametrize("location", ["record", "chunk", "text"])
def test_excessive_lengths_are_not_allocated(tmp_path: Path, length: int, location: str) -> None:
    """Check the readers of bags and of drive logs."""
    body = {
        "record": struct.pack("<BQ", 5, length),
        "chunk": mcap_record(6, struct.pack("<QQQI", 0, 1, 100, 0) + ZSTD + struct.pack("<Q", length) + b"abc"),
        "text": mcap_record(4, struct.pack("<HHI", 1, 1, min(length, 2**32 - 1))),
    }[location]
    path = _write_mcap(tmp_path / "length.mcap", body)
    _refusal(path)
    tracemalloc.start()
    assert not is_drive_log(path)
    with pytest.raises(ConfigError, match="length.mcap"):
        read_drive_log(path)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_unpacked_data_equal_the_original_data() -> None:
    """The data are equal for one or more frames; a wrong size raises ConfigError."""
    data = os.urandom(1000) * 3
    frames = zstandard.ZstdCompressor().compress(data[:1000]) + zstandard.ZstdCompressor().compress(data[1000:])
    for packed, compression in ((frames, "zstd"), (lz4.frame.compress(data), "lz4"), (data, "")):
        assert unpack(Path("x"), packed, compression, len(data)) == data
        for size in (len(data) - 1, len(data) + 1):
            with pytest.raises(ConfigError, match="declared"):
                unpack(Path("x"), packed, compression, size)
    with pytest.raises(ConfigError, match="compression 'rar' is not supported"):
        unpack(Path("x"), data, "rar")


@pytest.mark.parametrize("name", ["pipe.mcap", "pipe.db3", "pipe.bag", "bag/metadata.yaml", "bag/bag.mcap"])
def test_pipes_are_refused_without_opening(tmp_path: Path, name: str) -> None:
    """Opening a pipe would block forever, because no process writes to it."""
    pipe = tmp_path / name
    pipe.parent.mkdir(exist_ok=True)
    if name == "bag/bag.mcap":
        metadata = {"rosbag2_bagfile_information": {"relative_file_paths": ["bag.mcap"], "storage_identifier": "mcap"}}
        (pipe.parent / "metadata.yaml").write_text(yaml.safe_dump(metadata), encoding="utf-8")
    os.mkfifo(pipe)
    with pytest.raises(ConfigError, match="pipe or a device"):
        read_log(pipe.parent if pipe.parent != tmp_path else pipe)


def _write_database(path: Path, change: str) -> Path:
    base = sqlite3.connect(path)
    base.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
        "INSERT INTO topics VALUES (1, '/cmd_vel', 'geometry_msgs/msg/Twist', 'cdr');"
        "INSERT INTO messages VALUES (1, 1, 10, x'00'), (2, 1, 20, x'00');" + change
    )
    base.close()
    return path


_ENDLESS = "WITH RECURSIVE c(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM c)"
_NO_MESSAGES, _ONLY_TABLES = "DROP TABLE messages; ", "not only the tables of a bag"
_COMPUTED = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
    "data BLOB AS (zeroblob(900000000))); INSERT INTO messages(topic_id, timestamp) VALUES (1, 10)"
)
# SQLite would prepare a chain of views for an unlimited time, even if none is read.
_CHAIN = "".join(f"CREATE VIEW v{i} AS SELECT a.* FROM v{i - 1} a, v{i - 1} b;" for i in range(1, 60))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("UPDATE messages SET timestamp = 'noon' WHERE id = 2", "1 messages have a stamp"),
        ("UPDATE messages SET timestamp = NULL", "2 messages have a stamp"),
        (_NO_MESSAGES + _COMPUTED, _ONLY_TABLES),
        (f"{_NO_MESSAGES}CREATE VIEW messages AS {_ENDLESS} SELECT k AS id, 1 AS topic_id FROM c;", _ONLY_TABLES),
        (f"DROP TABLE topics; CREATE VIEW topics AS {_ENDLESS} SELECT k AS id, '/t' AS name FROM c;", _ONLY_TABLES),
        (f"{_NO_MESSAGES}CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data);", _ONLY_TABLES),
        (f"CREATE VIEW v0 AS SELECT * FROM messages;{_CHAIN}", _ONLY_TABLES),
    ],
)
def test_invalid_database_is_refused(tmp_path: Path, change: str, message: str) -> None:
    """Values have a wrong type, a computed column would return 900 MB, or a view or a virtual table runs code."""
    assert message in _refusal(_write_database(tmp_path / "bag.db3", change))


def test_bag_with_file_compression_is_refused(tmp_path: Path) -> None:
    metadata = {"relative_file_paths": ["bag.mcap.zstd"], "compression_format": "zstd", "compression_mode": "FILE"}
    (tmp_path / "bag.mcap.zstd").write_bytes(b"")
    (tmp_path / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": metadata}), encoding="utf-8")
    assert "its whole files are compressed; unpack the bag" in _refusal(tmp_path)


def test_error_for_a_compressed_file_contains_the_command(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap.zst"
    path.write_bytes(zstandard.ZstdCompressor().compress(b"anything"))
    assert "bag.mcap.zst: the whole file is compressed; unpack it: `zstd -d bag.mcap.zst`" in _refusal(path)


def test_more_frequent_of_two_types_on_a_topic_is_read(tmp_path: Path) -> None:
    topics = bag_topics(COLUMNS)
    _, *rows = topics["/cmd_vel"]
    stamped_messages = ("geometry_msgs/msg/TwistStamped", *(part[:50] + 0.5 for part in rows))
    log = read_log(write_bag(tmp_path / "bag", topics | {"/cmd_vel#stamped": stamped_messages}))
    assert [finding.place for finding in log.findings if finding.kind == "two types"] == ["bag, /cmd_vel"]
    assert records_are_equal(log.records[0], read_log(write_bag(tmp_path / "plain", topics)).records[0])


@pytest.mark.parametrize("count", [2, 10_000])
def test_repeated_file_is_refused_without_reading(tmp_path: Path, count: int) -> None:
    bag = write_bag(tmp_path / "bag", bag_topics(COLUMNS))
    metadata = bag / "metadata.yaml"
    content = yaml.safe_load(metadata.read_text(encoding="utf-8"))
    content["rosbag2_bagfile_information"]["relative_file_paths"] = ["bag.db3"] * count
    metadata.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(ConfigError, match=f"'bag.db3' {count:,} times; name it once"):
        read_log(bag)
    (bag / "linked.db3").symlink_to("bag.db3")
    content["rosbag2_bagfile_information"]["relative_file_paths"] = ["bag.db3", "linked.db3"]
    metadata.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(ConfigError, match="several names for one file"):
        read_log(bag)


def test_interrupt_of_a_statement_without_rows_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SQLite discards exceptions of its progress handler, so KeyboardInterrupt must be raised again."""

    def interrupt(_: object) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(sqlite_file._Watchdog, "check", interrupt)
    monkeypatch.setattr(sqlite_file, "_STEPS", 1)
    with pytest.raises(KeyboardInterrupt):
        read_log(_write_database(tmp_path / "bag.db3", ""))


def test_statement_with_too_many_steps_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite_file, "_STEPS", 1)
    limits = replace(file_limits(), sqlite_steps=3)
    monkeypatch.setattr(sqlite_file, "file_limits", lambda: limits)
    assert "too long" in _refusal(_write_database(tmp_path / "bag.db3", ""))
