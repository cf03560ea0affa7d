"""Small bags that would fill memory: refused before they are unpacked, with the memory counted."""

from __future__ import annotations

import os
import sqlite3
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import yaml
import zstandard

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs.bag_bounds import MOST_UNPACKED, unpacked
from diffdrive_mpc.models.logs.bag_topics import opened
from diffdrive_mpc.models.logs.drive_log.reader import is_drive_log, read_drive_log
from diffdrive_mpc.models.logs.reading import read_log

_MAGIC = b"\x89MCAP0\r\n"
_BLOCK = bytes(1_000_000)


def _text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def _record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def _message(content: bytes, time: int = 5) -> bytes:
    return _record(5, struct.pack("<HIQQ", 1, 0, time, time) + content)


_SCHEMA = _record(3, struct.pack("<H", 1) + _text("geometry_msgs/msg/Twist") + _text("ros2msg") + _text(""))
_CHANNEL = _record(4, struct.pack("<HH", 1, 1) + _text("/cmd_vel") + _text("cdr") + _text(""))


def _chunk(packed: bytes, how: str, size: int) -> bytes:
    return _record(6, struct.pack("<QQQI", 0, 10, size, 0) + _text(how) + struct.pack("<Q", len(packed)) + packed)


def _footer(summary: int = 0) -> bytes:
    return _record(2, struct.pack("<QQI", summary, 0, 0)) + _MAGIC


def _mcap(path: Path, body: bytes) -> Path:
    path.write_bytes(_MAGIC + _record(1, _text("ros2") + _text("test")) + _SCHEMA + _CHANNEL + body + _footer())
    return path


def _indexed(path: Path, chunks: list[bytes], mentioned: int = 1) -> Path:
    """A file whose index names each chunk so often."""
    body, index = _MAGIC + _record(1, _text("ros2") + _text("test")), b""
    for chunk in chunks:
        size = struct.unpack("<Q", chunk[25:33])[0]
        offsets = struct.pack("<I", 10) + struct.pack("<HQ", 1, len(body) + len(chunk))
        place = struct.pack("<QQQQ", 0, 10, len(body), len(chunk))
        index += _record(8, place + offsets + struct.pack("<Q", 31) + _text("zstd") + struct.pack("<QQ", 0, size))
        body += chunk
    path.write_bytes(body + _SCHEMA + _CHANNEL + index * mentioned + _footer(len(body)))
    return path


def _zeros_in_zstd(megabytes: int) -> bytes:
    packer = zstandard.ZstdCompressor().compressobj()
    return b"".join([*(packer.compress(_BLOCK) for _ in range(megabytes)), packer.flush()])


def _zeros_in_lz4(megabytes: int) -> bytes:
    packer = lz4.frame.LZ4FrameCompressor()
    return b"".join([packer.begin(), *(packer.compress(_BLOCK) for _ in range(megabytes)), packer.flush()])


def _refused(path: Path) -> str:
    """The line with which a bag is refused; it may take no more than twice what a chunk may."""
    tracemalloc.start()
    try:
        with pytest.raises(ConfigError) as error:
            read_log(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2.2 * MOST_UNPACKED, peak
    line = str(error.value)
    assert "\n" not in line
    assert path.name in line
    return line


@pytest.mark.parametrize(("how", "pack"), [("zstd", _zeros_in_zstd), ("lz4", _zeros_in_lz4)])
@pytest.mark.parametrize("said", [1_000, 400_000_000])
def test_a_bomb_is_not_unpacked_whether_or_not_it_says_what_it_is(
    tmp_path: Path, how: str, pack: Callable[[int], bytes], said: int
) -> None:
    """400 MB in some kilobytes."""
    path = _mcap(tmp_path / "bomb.mcap", _chunk(pack(400), how, said))
    assert "chunk" in _refused(path)


def test_many_chunks_are_counted_together(tmp_path: Path) -> None:
    """Each is small enough; all of them are far more than such a file holds."""
    whole = _message(bytes(1_000_000))
    packed = zstandard.ZstdCompressor().compress(whole)
    path = _mcap(tmp_path / "many.mcap", _chunk(packed, "zstd", len(whole)) * 40)
    assert "100 times its size" in _refused(path)


def test_chunks_of_one_time_are_not_held_together(tmp_path: Path) -> None:
    """The library would hold all of them at once; here they are made of noise, so that each is worth its size."""
    whole = _message(os.urandom(700_000) + bytes(40_000_000))
    packed = zstandard.ZstdCompressor().compress(whole)
    path = _indexed(tmp_path / "overlap.mcap", [_chunk(packed, "zstd", len(whole))] * 4)
    assert "same time" in _refused(path)


def test_an_index_that_names_a_chunk_again_and_again_is_refused(tmp_path: Path) -> None:
    """Else it would be read as often."""
    whole = _message(b"")
    chunk = _chunk(zstandard.ZstdCompressor().compress(whole), "zstd", len(whole))
    assert "index" in _refused(_indexed(tmp_path / "again.mcap", [chunk], mentioned=3))


@pytest.mark.parametrize("length", [3_000_000_000, 2**60])
@pytest.mark.parametrize("place", ["record", "chunk", "text"])
def test_absurd_lengths_are_not_allocated(tmp_path: Path, length: int, place: str) -> None:
    """Neither by the library of bags nor by that of drives."""
    body = {
        "record": struct.pack("<BQ", 5, length),
        "chunk": _record(6, struct.pack("<QQQI", 0, 1, 100, 0) + _text("zstd") + struct.pack("<Q", length) + b"abc"),
        "text": _record(4, struct.pack("<HHI", 1, 1, min(length, 2**32 - 1))),
    }[place]
    path = _mcap(tmp_path / "length.mcap", body)
    _refused(path)
    tracemalloc.start()
    assert not is_drive_log(path)
    with pytest.raises(ConfigError, match="length.mcap"):
        read_drive_log(path)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_what_is_unpacked_is_what_was_packed() -> None:
    """Bit for bit, also in several frames, and no byte more than is said."""
    data = os.urandom(1000) * 3
    frames = zstandard.ZstdCompressor().compress(data[:1000]) + zstandard.ZstdCompressor().compress(data[1000:])
    for packed, how in ((frames, "zstd"), (lz4.frame.compress(data), "lz4"), (data, "")):
        assert unpacked(Path("x"), packed, how, len(data)) == data
        for other in (len(data) - 1, len(data) + 1):
            with pytest.raises(ConfigError, match="says"):
                unpacked(Path("x"), packed, how, other)
    with pytest.raises(ConfigError, match="packed by 'rar'"):
        unpacked(Path("x"), data, "rar")


@pytest.mark.parametrize("name", ["pipe.mcap", "pipe.db3", "pipe.bag", "bag/metadata.yaml", "bag/bag.mcap"])
def test_pipes_are_refused_at_once(tmp_path: Path, name: str) -> None:
    """Nobody writes into them: who waits for that waits for ever."""
    pipe = tmp_path / name
    pipe.parent.mkdir(exist_ok=True)
    if name == "bag/bag.mcap":
        said = {"rosbag2_bagfile_information": {"relative_file_paths": ["bag.mcap"], "storage_identifier": "mcap"}}
        (pipe.parent / "metadata.yaml").write_text(yaml.safe_dump(said), encoding="utf-8")
    os.mkfifo(pipe)
    with pytest.raises(ConfigError, match="pipe or a device"):
        read_log(pipe.parent if pipe.parent != tmp_path else pipe)


def _data_base(path: Path, change: str) -> Path:
    base = sqlite3.connect(path)
    base.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
        "INSERT INTO topics VALUES (1, '/cmd_vel', 'geometry_msgs/msg/Twist', 'cdr');"
        "INSERT INTO messages VALUES (1, 1, 10, x'00'), (2, 1, 20, x'00');" + change
    )
    base.close()
    return path


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("UPDATE messages SET timestamp = 'noon' WHERE id = 2", "1 messages have a stamp"),
        ("UPDATE messages SET timestamp = x'07' WHERE id = 2", "1 messages have a stamp"),
        ("UPDATE messages SET timestamp = NULL", "2 messages have a stamp"),
        ("UPDATE messages SET timestamp = 0.5", "2 messages have a stamp"),
        ("UPDATE messages SET data = 'words'", "2 messages have a stamp"),
        (
            "DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            "data BLOB AS (zeroblob(900000000))); INSERT INTO messages(topic_id, timestamp) VALUES (1, 10)",
            "not that of a bag",
        ),
    ],
)
def test_a_data_base_of_something_else_is_refused(tmp_path: Path, change: str, words: str) -> None:
    """Values of a wrong type, and 900 MB that are nowhere in the file."""
    assert words in _refused(_data_base(tmp_path / "bag.db3", change))


def test_a_compressed_bag_is_unpacked_within_bounds_and_read(tmp_path: Path) -> None:
    """By file: what is in it is read as it is; a bomb in its place is refused."""
    whole = _message(b"\0" * 52)
    plain = _mcap(tmp_path / "plain.mcap", _chunk(whole, "", len(whole))).read_bytes()
    bag = tmp_path / "bag"
    bag.mkdir()
    topic = {"name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "serialization_format": "cdr"}
    said = {
        "version": 5,
        "storage_identifier": "mcap",
        "relative_file_paths": ["bag.mcap.zstd"],
        "duration": {"nanoseconds": 1},
        "starting_time": {"nanoseconds_since_epoch": 5},
        "message_count": 1,
        "topics_with_message_count": [{"topic_metadata": topic, "message_count": 1}],
        "compression_format": "zstd",
        "compression_mode": "FILE",
    }
    (bag / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": said}), encoding="utf-8")
    (bag / "bag.mcap.zstd").write_bytes(zstandard.ZstdCompressor().compress(plain))
    with opened(bag) as reader:
        assert [bytes(data) for _, _, data in reader.messages(reader.connections)] == [b"\0" * 52]
    (bag / "bag.mcap.zstd").write_bytes(_zeros_in_zstd(400))
    assert "unpacks to more than" in _refused(bag)
