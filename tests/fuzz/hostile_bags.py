# ruff: noqa: E501 - one line for each kind of attack
"""Makers of hostile bags: data bases, MCAP files, and folders of bags."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random

import lz4.frame
import yaml
import zstandard

from fuzz.hostile_texts import Content, Maker, hole, no_file, odd_name, written

# Data bases.

_TOPIC_TABLE = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
_TOPICS = f"{_TOPIC_TABLE} INSERT INTO topics VALUES (1, '/cmd_vel', 'geometry_msgs/msg/Twist', 'cdr'), (2, '/odom', 'nav_msgs/msg/Odometry', 'cdr');"
_MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
_NUMBERS = "WITH RECURSIVE c(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM c"
_ROWS = f"INSERT INTO messages {_NUMBERS} LIMIT 20000) SELECT k, 1 + k % 2, k, zeroblob(60) FROM c;"
_BAG = f"{_TOPICS} {_MESSAGES} {_ROWS}"
_SCHEMAS: dict[str, str] = {
    "endless view": f"{_TOPICS} CREATE VIEW messages AS {_NUMBERS}) SELECT k AS id, 1 AS topic_id, k AS timestamp, x'00' AS data FROM c;",
    "views of views": f"{_BAG} CREATE VIEW v0 AS SELECT * FROM messages;" + "".join(f"CREATE VIEW v{i} AS SELECT a.* FROM v{i - 1} a, v{i - 1} b;" for i in range(1, 60)),
    "virtual table": f"{_TOPICS} CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data);",
    "generated column": f"{_TOPICS} {_MESSAGES.replace('BLOB', 'BLOB AS (zeroblob(900000000))')} INSERT INTO messages(topic_id, timestamp) VALUES (1, 10);",
    "many topics": f"{_TOPIC_TABLE} {_MESSAGES} {_ROWS} INSERT INTO topics {_NUMBERS} LIMIT 50000) SELECT k, '/t' || k, 'geometry_msgs/msg/Twist', 'cdr' FROM c;",
    "long names": f"{_TOPIC_TABLE} {_MESSAGES} {_ROWS} INSERT INTO topics VALUES (1, CAST(zeroblob(30000000) AS TEXT), 't', 'cdr');",
    "zeroblob": f"{_TOPICS} {_MESSAGES} INSERT INTO messages {_NUMBERS} LIMIT 3) SELECT k, 1 + k % 2, k, zeroblob(70000000 * (k % 2)) FROM c;",
}  # fmt: skip


def _data_base(script: str, random: Random, folder: Path, page: int = 0) -> Path:
    path = folder / "bag.db3"
    base = sqlite3.connect(path)
    base.executescript(
        f"PRAGMA synchronous = OFF; PRAGMA page_size = {page or random.choice((512, 4096, 65536))}; {script}"
    )
    base.commit()
    base.close()
    return path


def _damaged_pages(random: Random, folder: Path) -> Path:
    """Change bytes and whole pages."""
    path = _data_base(f"{_BAG} CREATE INDEX timestamp_idx ON messages(timestamp);", random, folder)
    content = bytearray(path.read_bytes())
    size = int.from_bytes(content[16:18], "big") or 65536
    for _ in range(random.choice((1, 10, 200))):
        page, source = (random.randrange(len(content) // size) * size for _ in range(2))
        if random.random() < 0.3 and page:
            content[page : page + size] = content[source : source + size]
        else:
            offset = random.randrange(100, len(content) - 4)
            content[offset : offset + 4] = random.choice(
                (bytes(4), b"\xff" * 4, bytes((0, 0, 0, random.randrange(50))))
            )
    path.write_bytes(content)
    return path


# MCAP files.

MAGIC = b"\x89MCAP0\r\n"


def mcap_text(words: str | bytes) -> bytes:
    data = words if isinstance(words, bytes) else words.encode("utf-8", "surrogatepass")
    return struct.pack("<I", len(data)) + data


def mcap_record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def mcap_message(content: bytes = b"", time: int = 5, channel: int = 1) -> bytes:
    return mcap_record(5, struct.pack("<HIQQ", channel, 0, time, time) + content)


def mcap_topic(name: str, kind: str = "geometry_msgs/msg/Twist", number: int = 1, encoding: str = "cdr", data: bytes = b"") -> bytes:  # fmt: skip
    schema = mcap_record(3, struct.pack("<H", number) + mcap_text(kind) + mcap_text("ros2msg") + mcap_text(data))
    return schema + mcap_record(
        4, struct.pack("<HH", number, number) + mcap_text(name) + mcap_text(encoding) + mcap_text(data)
    )


def mcap_chunk(packed: bytes, how: str, size: int) -> bytes:
    return mcap_record(
        6, struct.pack("<QQQI", 0, 10, size, 0) + mcap_text(how) + struct.pack("<Q", len(packed)) + packed
    )


def zeros(megabytes: int, how: str, head: bytes = b"") -> bytes:
    """Return packed zeros after `head`."""
    packer = lz4.frame.LZ4FrameCompressor() if how == "lz4" else zstandard.ZstdCompressor().compressobj()
    first = packer.begin() if how == "lz4" else b""
    packed = (packer.compress(part) for part in (head, *[bytes(10**6)] * megabytes) if part)
    return b"".join((first, *packed, packer.flush()))


def _bomb(random: Random) -> bytes:
    how, megabytes = random.choice(("zstd", "lz4")), random.choice((60, 300))
    size = random.choice((megabytes * 1_000_000, 100, 2**62))
    return mcap_chunk(zeros(megabytes, how), how, size) * random.choice((1, 5))


def _lying_length(random: Random) -> bytes:
    kind, name = random.choice((3, 4, 5, 6, 9, 12)), random.choice((2**32 - 1, 10**6))
    sound = mcap_record(kind, struct.pack("<HI", 1, name) + bytes(10**6))
    length = struct.pack("<BQ", kind, random.choice((2**32, 2**63 - 1, 2**64 - 1, 10**8)))
    return random.choice((sound, length + sound[9:]))


def _ticks(row: str, count: int, random: Random) -> bytes:
    """Return ticks of a drive in chunks that pack well; `*` in `row` stands for a drawn value."""
    drawn = random.choice(("9" * 5_000, "1e999", "9" * 400, '"x"', "null", "[1]", "[" * 2_000, "[" * 10**6))
    data = row.replace("*", drawn).encode()
    step = max(1, 10**7 // len(data))
    chunks = [b"".join(mcap_message(data, k) for k in range(n, min(n + step, count))) for n in range(0, count, step)]
    packed = [mcap_chunk(zstandard.compress(chunk), "zstd", len(chunk)) for chunk in chunks]
    return mcap_topic("/diffdrive_mpc/state", "diffdrive_mpc.State", encoding="json") + b"".join(packed)


_BODIES: dict[str, Content] = {
    "bomb": _bomb,
    "lying length": _lying_length,
    "channels": lambda random: b"".join(mcap_topic(f"/t{k}", number=k) for k in range(1, 65_536)),
    "odd names": lambda random: mcap_topic(odd_name(random), odd_name(random)) + mcap_message(),
    "messages": lambda random: mcap_topic("/cmd_vel") + mcap_message() * 500_000,
    "nested ticks": partial(_ticks, '{"a":*', 20),
    "empty ticks": partial(_ticks, "{}", 450_000),
    "large tick": lambda random: _ticks('{"a":[' + "[]," * 12_000_000 + "[]]}", 1, random),
}  # fmt: skip


def _mcap(make: Content, random: Random, folder: Path) -> Path:
    end = mcap_record(2, struct.pack("<QQI", random.choice((0, 8, 10**6)), 0, 0)) + MAGIC
    content = (
        MAGIC
        + mcap_record(1, mcap_text("ros2") + mcap_text("x"))
        + make(random)
        + random.choice((end, end, b"", bytes(9)))
    )
    return written("bag.mcap", lambda _: content, random, folder)


# Folders of bags.

_FOLDERS: dict[str, Callable[[Random], dict[str, object]]] = {
    "links": lambda random: {"relative_file_paths": [f"{k}.db3" for k in range(random.choice((900, 10_000)))]},
    "places": lambda random: {"relative_file_paths": random.choices(("../../../../etc/passwd", "/dev/zero", "\x00", "\x1b[2J.db3", "x" * 5_000), k=3)},
    "no names": lambda random: {"relative_file_paths": random.choice((None, {}, "bag.db3", 5, [], [[]], [None], ["missing.db3"]))},
    "many topics": lambda random: {"topics_with_message_count": [{"topic_metadata": {"name": f"/t{k}"}} for k in range(random.choice((2_000, 40_000)))]},
    "packed whole": lambda random: {"compression_mode": random.choice(("file", "FILE")), "compression_format": random.choice(("zstd", "zstd", "rar"))},
}  # fmt: skip


def _folder(kind: str, random: Random, folder: Path) -> Path:
    """Write a bag with a metadata.yaml; its file is a sound data base, a bomb, or no file."""
    (bag := folder / "bag").mkdir()
    path = _data_base(_BAG, random, bag)
    information = {"relative_file_paths": ["bag.db3"], **_FOLDERS[kind](random)}
    if kind == "links":
        for k in range(900):
            (bag / f"{k}.db3").symlink_to("bag.db3")
    elif kind == "packed whole":
        head = random.choice((MAGIC + struct.pack("<BQ", 9, 2**62), b"SQLite format 3\0", b""))
        sound = zstandard.compress(path.read_bytes())
        path.write_bytes(random.choice((zeros(random.choice((15, 500)), "zstd", head), sound, sound[:5_000])))
    stated = {"rosbag2_bagfile_information": information}
    text = yaml.dump(stated, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper))
    (bag / "metadata.yaml").write_text(text, encoding="utf-8")
    return bag


_BEGINNINGS = {"bag.db3": b"SQLite format 3\0", "bag.mcap": MAGIC, "bag.bag": b"#ROSBAG V2.0\n"}
_ODD_TOPICS = f"{_BAG} UPDATE topics SET name = '\x1b[2J' || char(8238), type = char(155) || '31m' || char(10);"
BAGS: dict[str, Maker] = {
    **{f"log: SQLite {name}": partial(_data_base, script) for name, script in _SCHEMAS.items()},
    "log: SQLite odd topics": partial(_data_base, _ODD_TOPICS),
    **{f"log: SQLite damaged pages {k}": _damaged_pages for k in range(5)},
    **{f"{door}: MCAP {name}": partial(_mcap, make) for name, make in _BODIES.items() for door in ("log", "replay")},
    **{f"log: folder {name}": partial(_folder, name) for name in _FOLDERS},
    **{f"log: no file {name}": partial(no_file, name) for name in _BEGINNINGS},
    **{f"log: hole {name}": partial(hole, name, head) for name, head in _BEGINNINGS.items()},
}
