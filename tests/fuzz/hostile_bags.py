# ruff: noqa: E501 - one line for each kind of attack
"""Makers of hostile bags: data bases, MCAP files, bags of ROS 1, and folders of bags."""

from __future__ import annotations

import bz2
import os
import shutil
import sqlite3
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random

import lz4.frame
import yaml
import zstandard

from fuzz.hostile_texts import odd_name, special

# Data bases.

_TOPICS = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
    "INSERT INTO topics VALUES (1, '/cmd_vel', 'geometry_msgs/msg/Twist', 'cdr'), (2, '/odom', 'nav_msgs/msg/Odometry', 'cdr');"
)
_MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
_NUMBERS = "WITH RECURSIVE c(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM c"
_ROWS = f"INSERT INTO messages {_NUMBERS} LIMIT 20000) SELECT k, 1 + k % 2, k, zeroblob(60) FROM c;"
_FORGE = "PRAGMA writable_schema = ON; UPDATE sqlite_master SET "

_SCHEMAS: dict[str, str] = {
    "endless view": f"{_TOPICS} CREATE VIEW messages AS {_NUMBERS}) SELECT k AS id, 1 AS topic_id, k AS timestamp, x'00' AS data FROM c;",
    "endless view of topics": f"{_MESSAGES} {_ROWS} CREATE VIEW topics AS {_NUMBERS}) SELECT k AS id, '/t' AS name, 't' AS type, 'cdr' AS serialization_format FROM c;",
    "forged kind": f"{_TOPICS} CREATE VIEW messages AS {_NUMBERS}) SELECT k AS id FROM c; {_FORGE} type = 'table' WHERE name = 'messages';",
    "forged table": f"{_TOPICS} {_MESSAGES} {_ROWS} CREATE TABLE t(x); {_FORGE} sql = 'CREATE VIEW messages AS SELECT 1', rootpage = 0 WHERE name = 'messages';",
    "virtual table": f"{_TOPICS} CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data);",
    "made column": f"{_TOPICS} CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB AS (zeroblob(900000000))); INSERT INTO messages(topic_id, timestamp) VALUES (1, 10);",
    "without rowid": f"{_TOPICS} CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB) WITHOUT ROWID; {_ROWS}",
    "topics": f"CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT); {_MESSAGES} {_ROWS} INSERT INTO topics {_NUMBERS} LIMIT 50000) SELECT k, '/t' || k, 'geometry_msgs/msg/Twist', 'cdr' FROM c;",
    "one id of topics": f"CREATE TABLE topics(id, name, type, serialization_format); {_MESSAGES} {_ROWS} INSERT INTO topics {_NUMBERS} LIMIT 9000) SELECT 1, '/t', 'geometry_msgs/msg/Twist', 'cdr' FROM c;",
    "long names": f"{_MESSAGES} {_ROWS} CREATE TABLE topics(id, name, type, serialization_format); INSERT INTO topics VALUES (1, CAST(zeroblob(30000000) AS TEXT), 't', 'cdr');",
    "wrong types": f"{_TOPICS} {_MESSAGES} {_ROWS} UPDATE messages SET timestamp = 'noon' WHERE id % 3 = 0;",
    "huge stamps": f"{_TOPICS} {_MESSAGES} {_ROWS} UPDATE messages SET timestamp = (id % 2) * 9223372036854775807 - 9000000000000000000;",
    "large messages": f"{_TOPICS} {_MESSAGES} INSERT INTO messages {_NUMBERS} LIMIT 3) SELECT k, 1 + k % 2, k, zeroblob(70000000 * (k % 2)) FROM c;",
    "rows": f"{_TOPICS} {_MESSAGES} INSERT INTO messages {_NUMBERS} LIMIT 400000) SELECT k, 1 + k % 2, k * 1000000, zeroblob(0) FROM c;",
    "tables": f"{_TOPICS} {_MESSAGES} {_ROWS}" + "".join(f"CREATE TABLE t{i}(a, b, c);" for i in range(3_000)),
    "views of views": f"{_TOPICS} {_MESSAGES} {_ROWS} CREATE VIEW v0 AS SELECT * FROM messages;"
    + "".join(f"CREATE VIEW v{i} AS SELECT a.* FROM v{i - 1} a, v{i - 1} b;" for i in range(1, 60)),
    "trigger and statistics": f"{_TOPICS} {_MESSAGES} {_ROWS} CREATE INDEX timestamp_idx ON messages(timestamp); ANALYZE; UPDATE sqlite_stat1 SET stat = '1 1';",
    "collation": f"{_TOPICS} CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB); {_ROWS} {_FORGE} sql = replace(sql, 'timestamp INTEGER', 'timestamp INTEGER COLLATE evil') WHERE name = 'messages';",
    "empty": "",
}


def _data_base(script: str, random: Random, folder: Path) -> Path:
    path = folder / "bag.db3"
    with sqlite3.connect(path) as base:
        base.execute(f"PRAGMA page_size = {random.choice((512, 4096, 65536))}")
        base.executescript(script)
    base.close()
    return path


def _beside(random: Random, folder: Path) -> Path:
    """Put a journal or log of changes beside the file."""
    path = _data_base(f"{_TOPICS} {_MESSAGES} {_ROWS}", random, folder)
    beside = path.with_name(path.name + random.choice(("-wal", "-journal", "-shm")))
    if random.random() < 0.5:
        beside.write_bytes(bytes(random.randrange(256) for _ in range(5_000)))
    else:
        special(beside, random)
    return path


def _odd_topics(random: Random, folder: Path) -> Path:
    path = _data_base(_MESSAGES + _TOPICS + _ROWS, random, folder)
    with sqlite3.connect(path) as base:
        base.execute("UPDATE topics SET name = ?, type = ?", (odd_name(random), odd_name(random)))
    base.close()
    return path


def _damaged_pages(random: Random, folder: Path) -> Path:
    """Change bytes and whole pages."""
    path = _data_base(
        f"{_TOPICS} {_MESSAGES} {_ROWS} CREATE INDEX timestamp_idx ON messages(timestamp);", random, folder
    )
    content = bytearray(path.read_bytes())
    size = int.from_bytes(content[16:18], "big") or 65536
    for _ in range(random.choice((1, 10, 200))):
        page, source = random.randrange(len(content) // size) * size, random.randrange(len(content) // size) * size
        if random.random() < 0.3 and page:
            content[page : page + size] = content[source : source + size]
        else:
            offset = random.randrange(100, len(content) - 4)
            content[offset : offset + 4] = random.choice(
                (bytes(4), b"\xff" * 4, struct.pack(">I", random.randrange(50)))
            )
    path.write_bytes(content)
    return path


def _page(kind: int, cells: list[bytes], right: int = 0) -> bytes:
    """Return a page of 512 bytes of a b-tree."""
    head = struct.pack(">BHHHB", kind, 0, len(cells), 0, 0) + (struct.pack(">I", right) if kind == 5 else b"")
    page, offset = bytearray(512), 512
    for number, cell in enumerate(cells):
        offset -= len(cell)
        page[offset : offset + len(cell)] = cell
        struct.pack_into(">H", page, len(head) + 2 * number, offset)
    page[: len(head)] = head
    struct.pack_into(">H", page, 5, offset)
    return bytes(page)


def _endless_pages(random: Random, folder: Path) -> Path:
    """Write a table whose pages name one page below them again and again: some kilobytes, and rows without end."""
    path = folder / "bag.db3"
    with sqlite3.connect(path) as base:
        base.execute("PRAGMA page_size = 512")
        base.executescript(_TOPICS + _MESSAGES)
        (root,) = base.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = ?", (random.choice(("messages", "topics")),)
        ).fetchone()
    base.close()
    content = bytearray(path.read_bytes())
    depth, first = random.choice((1, 6, 15)), len(content) // 512 + 1
    for level in range(depth):
        below = first + level
        # Each cell of an inner page: number of the page below, and a key.
        inner = _page(5, [struct.pack(">I", below) + bytes([k + 1]) for k in range(60)], below)
        if level == 0:
            content[512 * (root - 1) : 512 * root] = inner
        else:
            content += inner
    record = b"\x05\x00\x01\x01\x0c\x01\x05"  # header of five bytes; no number, one byte, one byte, no blob
    content += _page(13, [bytes([len(record), k + 1]) + record for k in range(20)])
    struct.pack_into(">I", content, 28, len(content) // 512)
    path.write_bytes(content)
    return path


# MCAP files.

_MAGIC = b"\x89MCAP0\r\n"


def _text(words: str | bytes) -> bytes:
    data = words if isinstance(words, bytes) else words.encode("utf-8", "surrogatepass")
    return struct.pack("<I", len(data)) + data


def _record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def _message(content: bytes, time: int = 5, channel: int = 1) -> bytes:
    return _record(5, struct.pack("<HIQQ", channel, 0, time, time) + content)


def _schema(name: str = "geometry_msgs/msg/Twist", number: int = 1, data: bytes = b"") -> bytes:
    return _record(3, struct.pack("<H", number) + _text(name) + _text("ros2msg") + _text(data))


def _channel(
    topic: str = "/cmd_vel", number: int = 1, encoding: str = "cdr", schema: int = 1, data: bytes = b""
) -> bytes:
    return _record(4, struct.pack("<HH", number, schema) + _text(topic) + _text(encoding) + _text(data))


def _chunk(packed: bytes, how: str, size: int, checksum: int = 0) -> bytes:
    return _record(
        6, struct.pack("<QQQI", 0, 10, size, checksum) + _text(how) + struct.pack("<Q", len(packed)) + packed
    )


def _zeros(megabytes: int, how: str) -> bytes:
    if how == "lz4":
        return bytes(lz4.frame.compress(bytes(megabytes * 1_000_000)))
    packer = zstandard.ZstdCompressor().compressobj()
    return b"".join([*(packer.compress(bytes(1_000_000)) for _ in range(megabytes)), packer.flush()])


def _bomb(random: Random) -> bytes:
    how, megabytes = random.choice(("zstd", "lz4")), random.choice((60, 300))
    packed = _zeros(megabytes, how)
    return _chunk(packed, how, random.choice((megabytes * 1_000_000, 100, 2**62))) * random.choice((1, 5))


def _ticks(make: Callable[[Random], tuple[bytes, int]], random: Random) -> bytes:
    """Return ticks of a drive in chunks that pack well."""
    row, count = make(random)
    body = _schema("diffdrive_mpc.State", 1) + _channel("/diffdrive_mpc/state", 1, "json")
    whole = b"".join(_message(row, k) for k in range(count))
    return body + b"".join(
        _chunk(
            zstandard.ZstdCompressor().compress(whole[offset : offset + 10**7]),
            "zstd",
            len(whole[offset : offset + 10**7]),
        )
        for offset in range(0, len(whole), 10**7)
    )


_BODIES: dict[str, Callable[[Random], bytes]] = {
    "bomb": _bomb,
    "chunk in a chunk": lambda random: _chunk(
        _chunk(_message(b""), "", len(_message(b""))) * 100,
        "",
        100 * len(_chunk(_message(b""), "", len(_message(b"")))),
    ),
    "lengths": lambda random: (
        struct.pack("<BQ", random.choice((3, 4, 5, 6, 9, 12)), random.choice((2**32, 2**63 - 1, 2**64 - 1, 10**8)))
        + bytes(100)
    ),
    "names": lambda random: _record(
        random.choice((3, 4, 12)), struct.pack("<HI", 1, random.choice((2**32 - 1, 10**6))) + bytes(10**6)
    ),
    "channels": lambda random: _schema() + b"".join(_channel(f"/t{k}", k) for k in range(65_536)),
    "definition": lambda random: _schema(data=bytes(60_000_000)) + _channel(),
    "qualities": lambda random: (
        _schema()
        + b"".join(
            _channel(f"/t{k}", k, data=_text("offered_qos_profiles") + _text("- {a: [" + "1," * 50_000 + "]}\n"))
            for k in range(20)
        )
    ),
    "odd names": lambda random: _schema(odd_name(random)) + _channel(odd_name(random)) + _message(b""),
    "unknown records": lambda random: _record(0x80, b"") * 500_000,
    "metadata": lambda random: _record(
        12, _text("configuration") + _text(b"".join(_text(f"k{k}") + _text("v") for k in range(100_000)))
    ),
    "messages": lambda random: _schema() + _channel() + _message(b"") * 500_000,
    "messages of nothing": lambda random: _message(b"", channel=7) * 10,
    "arrays": lambda random: (
        _schema("sensor_msgs/msg/JointState")
        + _channel("/odom")
        + _schema(number=2)
        + _channel("/cmd_vel", 2, schema=2)
        + _message(bytes(60), channel=2)
        + _message(bytes(12) + b"\xff" * 60)
    ),
    "deep ticks": partial(_ticks, lambda random: (b'{"a":' + b"[" * random.choice((500, 2_000, 10**6)), 20)),
    "empty ticks": partial(_ticks, lambda random: (b"{}", 450_000)),
    "large ticks": partial(_ticks, lambda random: (b'{"a":[' + b"[]," * 12_000_000 + b"[]]}", 1)),
    "numbers in ticks": partial(
        _ticks,
        lambda random: (
            b'{"t_s": '
            + random.choice((b"9" * 5_000, b"1e999", b"9" * 400, b'"x"', b"null", b"[1]"))
            + b', "mode": "TRACKING"}',
            100,
        ),
    ),
    "keys in ticks": partial(
        _ticks, lambda random: (b"{" + b",".join(b'"k%d":1' % k for k in range(20_000)) + b"}", 50)
    ),
    "odd ticks": partial(
        _ticks, lambda random: ('{"mode": "\x7f\u202e\\u001b[2J", "t_s": 1, "message": "\\u001b[31m"}'.encode(), 100)
    ),
}


def _mcap(make: Callable[[Random], bytes], name: str, random: Random, folder: Path) -> Path:
    path = folder / "bag.mcap"
    end = _record(2, struct.pack("<QQI", random.choice((0, 8, 10**6)), 0, 0)) + _MAGIC
    path.write_bytes(
        _MAGIC + _record(1, _text("ros2") + _text("x")) + make(random) + random.choice((end, end, b"", bytes(9)))
    )
    return path


# Bags of ROS 1.


def _field(name: str, value: bytes) -> bytes:
    return struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value


def _ros1_record(data: bytes, **fields: bytes) -> bytes:
    head = b"".join(_field(name, value) for name, value in fields.items())
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def _connection(topic: str = "/odom", kind: str = "nav_msgs/Odometry") -> bytes:
    inner = (
        _field("type", kind.encode("utf-8", "surrogatepass"))
        + _field("md5sum", b"0")
        + _field("message_definition", b"")
    )
    return _ros1_record(inner, op=b"\x07", conn=bytes(4), topic=topic.encode("utf-8", "surrogatepass"))


def _ros1(random: Random, folder: Path) -> Path:
    packed = bz2.compress(_connection() + _ros1_record(bytes(30_000_000), op=b"\x02", conn=bytes(4), time=bytes(8)))
    chunk = _ros1_record(
        packed, op=b"\x05", compression=b"bz2", size=struct.pack("<I", random.choice((30_000_200, 100, 2**32 - 1)))
    )
    info = _ros1_record(
        bytes(8),
        op=b"\x06",
        ver=struct.pack("<I", 1),
        chunk_pos=struct.pack("<Q", 4117),
        count=struct.pack("<I", 1),
        start_time=bytes(8),
        end_time=bytes(8),
    )
    body = random.choice(
        (
            chunk,
            chunk * 20,
            info * 20_000,
            _connection("/" + "x" * 1_000_000),
            _connection(odd_name(random), odd_name(random)),
            bytes(8) * 100_000,
            b"\xff" * 100,
            struct.pack("<I", 20) + b"\xff" * 20 + struct.pack("<I", 2**32 - 1),
            _connection() + _ros1_record(b"", op=b"\x02", conn=b"\x09\0\0\0", time=bytes(8)),
            _connection() + _ros1_record(b"\xff" * 80, op=b"\x02", conn=bytes(4), time=bytes(8)) * 50_000,
        )
    )
    head = _ros1_record(
        bytes(4027), op=b"\x03", index_pos=struct.pack("<Q", 4117), conn_count=b"\xff" * 4, chunk_count=b"\xff" * 4
    )
    path = folder / "drive.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + head + body)
    return path


# Folders of bags.


def _folder(random: Random, folder: Path) -> Path:
    """Write a metadata.yaml with odd names of files."""
    bag = folder / "bag"
    bag.mkdir()
    _data_base(f"{_TOPICS} {_MESSAGES} {_ROWS}", random, bag)
    kind = random.choice(("repeated", "links", "many", "place", "large", "no names", "missing", "special", "counts"))
    names: object = ["bag.db3"]
    more: dict[str, object] = {}
    if kind == "repeated":
        names = [random.choice(("bag.db3", "bag/bag.db3", "./bag.db3")) for _ in range(10_000)]
    elif kind in ("links", "many"):
        count = 10_000 if kind == "links" else 900
        names = [f"{k}.db3" for k in range(count)]
        for name in names if count < 1_000 else names[:100]:
            (bag / name).symlink_to("bag.db3")
    elif kind == "place":
        names = ["../../../../etc/passwd", "/dev/zero", "\x00", "\x1b[2J.db3", "x" * 5_000]
    elif kind == "large":
        more = {
            "topics_with_message_count": [
                {"topic_metadata": {"name": f"/t{k}", "offered_qos_profiles": "- a: 1\n" * 20}}
                for k in range(random.choice((2_000, 60_000)))
            ]
        }
    elif kind == "no names":
        names = random.choice((None, {}, "bag.db3", 5, [], [[]], [None]))
    elif kind == "missing":
        names = ["source.db3"]
    elif kind == "special":
        (bag / "bag.db3").unlink()
        special(bag / "bag.db3", random)
    elif kind == "counts":
        more = {
            "topics_with_message_count": [
                {"topic_metadata": {"name": "/odom"}, "message_count": random.choice((10**30, -1, "x", 1e99))}
            ]
        }
    stated = {"version": 5, "storage_identifier": "sqlite3", "relative_file_paths": names, **more}
    text = yaml.dump({"rosbag2_bagfile_information": stated}, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper))
    (bag / "metadata.yaml").write_text(text, encoding="utf-8")
    return bag


def _packed(random: Random, folder: Path) -> Path:
    """Write a bag that is compressed as a whole, or message by message."""
    bag = folder / "bag"
    bag.mkdir()
    mode = random.choice(("file", "FILE", "message"))
    head = random.choice((_MAGIC + struct.pack("<BQ", 9, 2**62), b"SQLite format 3\0", b""))
    packer = zstandard.ZstdCompressor().compressobj()
    bomb = b"".join(
        [
            packer.compress(head),
            *(packer.compress(bytes(1_000_000)) for _ in range(random.choice((15, 500)))),
            packer.flush(),
        ]
    )
    name = "bag.db3.zstd"
    if mode == "message":
        name = "bag.db3"
        _data_base(f"{_TOPICS} {_MESSAGES}", random, bag)
        with sqlite3.connect(bag / name) as base:
            base.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", [(k, 1 + k % 2, k, bomb) for k in range(10)])
        base.close()
    elif random.random() < 0.3:
        _data_base(f"{_TOPICS} {_MESSAGES} {_ROWS}", random, bag)
        (bag / name).write_bytes(
            zstandard.ZstdCompressor().compress((bag / "bag.db3").read_bytes())[: random.choice((None, 5_000))]
        )
    else:
        (bag / name).write_bytes(bomb)
    stated = {
        "relative_file_paths": [name],
        "compression_mode": mode,
        "compression_format": random.choice(("zstd", "zstd", "rar")),
    }
    (bag / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": stated}), encoding="utf-8")
    return bag


def _special(random: Random, folder: Path) -> Path:
    return special(folder / f"bag.{random.choice(('db3', 'mcap', 'bag'))}", random)


def _edited(random: Random, folder: Path) -> Path:
    """Change bytes of a sound log."""
    from fuzz import logs, mutation

    base = random.choice(logs.BASES)
    edits = [mutation.draw_bytes_edit(random) for _ in range(random.choice((1, 5, 20)))]
    path, mapping = logs.changed_file({"base": base, "edits": edits, "messages": logs.draw_messages(random)}, folder)
    if mapping is not None:
        shutil.copy(mapping, folder / "mapping.yaml")
    return path


def _many_zeros(random: Random, folder: Path) -> Path:
    """Write a hole of a gigabyte behind the first bytes of a bag."""
    path = folder / f"bag.{random.choice(('db3', 'mcap', 'bag'))}"
    path.write_bytes(random.choice((b"SQLite format 3\0", _MAGIC, b"#ROSBAG V2.0\n", b"")))
    os.truncate(path, 1_000_000_000)
    return path


BAGS: dict[str, Callable[[Random, Path], Path]] = {
    **{f"log: SQLite {name}": partial(_data_base, script) for name, script in _SCHEMAS.items()},
    **{f"log: SQLite {name}": make for name, make in (("file beside", _beside), ("odd topics", _odd_topics))},
    **{f"log: SQLite damaged pages {k}": _damaged_pages for k in range(6)},
    **{f"log: SQLite endless pages {k}": _endless_pages for k in range(3)},
    **{
        f"{door}: MCAP {name}": partial(_mcap, make, name)
        for name, make in _BODIES.items()
        for door in ("log", "replay")
    },
    **{f"log: ROS 1 {k}": _ros1 for k in range(10)},
    **{f"log: folder {k}": _folder for k in range(10)},
    **{f"log: packed {k}": _packed for k in range(6)},
    **{f"{door}: edited {k}": _edited for k in range(6) for door in ("log", "replay")},
    **{f"log: bag that is no file {k}": _special for k in range(4)},
    "log: hole": _many_zeros,
    "log: hole again": _many_zeros,
}
