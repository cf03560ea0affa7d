"""What a bag may take: looked at before a library unpacks it, so that a small file can fill neither memory nor disk.

The libraries allocate what a file says, and unpack what it holds. Here its records are walked through once, chunk by
chunk: lengths, what each chunk unpacks to, and what would be held at a time.
"""

from __future__ import annotations

import heapq
import os
import shutil
import struct
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from io import BytesIO
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, BinaryIO
from urllib.parse import quote

import yaml

from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.input_file import MEGABYTE, open_input

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

MOST_UNPACKED = file_limits().bag_chunk
"""Of one chunk or message."""
MOST_OPEN = file_limits().bag_open
"""Of chunks whose times overlap, which are held together."""
MOST_RATIO, ALWAYS = file_limits().bag_ratio, file_limits().bag_always
"""A file may unpack to so many times its size, and to so much in any case."""
_MCAP, _ROS1, _SQLITE = b"\x89MCAP0\r\n", b"#ROSBAG ", b"SQLite f"
_CHUNK, _CHUNK_INDEX = 0x06, 0x08
_BLOCK = 1 << 20
_SMALLER = "record it in smaller chunks, or uncompressed"


class Budget:
    """How much more a file of `size` bytes at `path` may unpack to."""

    def __init__(
        self, path: Path, size: int, remedy: str = "convert it to an uncompressed bag (`ros2 bag convert`)"
    ) -> None:
        self._path, self._left, self._remedy = path, max(ALWAYS, MOST_RATIO * size), remedy
        self._most = self._left

    def take(self, count: int) -> None:
        """Count what was unpacked; raises ConfigError where it is too much for such a file."""
        self._left -= count
        if self._left < 0:
            raise ConfigError(
                f"{self._path}: unpacks to more than {self._most / MEGABYTE:g} MB, {MOST_RATIO} times its size; "
                f"if it is sound, {self._remedy}"
            )


def unpacked(path: Path, data: bytes, how: str, size: int | None = None) -> bytes:
    """What `data` of a file unpack to, with no more memory than that takes and `MOST_UNPACKED` at most.

    Parameters
    ----------
    path
        The file, for messages.
    data
        As it stands there.
    how
        "zstd", "lz4", "bz2", or "" or "none" for what is not packed.
    size
        What it says that it unpacks to [bytes]; None where it does not say.

    Raises
    ------
    models.checked_yaml.ConfigError
        If it unpacks to more, or to something else than it says.
    """
    most = MOST_UNPACKED if size is None else size
    if most > MOST_UNPACKED:
        raise ConfigError(
            f"{path}: a chunk of {most / MEGABYTE:,.0f} MB, at most {MOST_UNPACKED / MEGABYTE:g} are read; {_SMALLER}"
        )
    try:
        content = _unpack(data, how, most + 1)
    except Exception as error:  # each library has its own
        raise ConfigError(f"{path}: a chunk cannot be unpacked ({' '.join(str(error).split())})") from error
    if len(content) > most or (size is not None and len(content) != size):
        raise ConfigError(f"{path}: a chunk does not unpack to the {most} bytes that it says; is the file damaged?")
    return content


def _unpack(data: bytes, how: str, most: int) -> bytes:
    if how in ("", "none"):
        return data
    if how == "zstd":
        from zstandard import ZstdDecompressor  # noqa: PLC0415 - only who reads bags needs it

        return bytes(ZstdDecompressor().stream_reader(BytesIO(data), read_across_frames=True).read(most))
    if how == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]  # noqa: PLC0415

        return bytes(LZ4FrameDecompressor().decompress(data, max_length=most))
    if how == "bz2":
        from bz2 import BZ2Decompressor  # noqa: PLC0415

        return BZ2Decompressor().decompress(data, max_length=most)
    raise ValueError(f"it is packed by '{how}'")


@contextmanager
def within_bounds(path: Path) -> Iterator[Path]:
    """Give the path at which a library may open the bag at `path`: its own, or that of a copy that is unpacked.

    Raises
    ------
    models.checked_yaml.ConfigError
        If one of its files is no regular file, or says or takes more than is read.
    """
    if not path.is_dir():
        check_file(path)
        yield path
        return
    metadata = path / "metadata.yaml"
    try:
        stated = read_yaml(metadata) if os.path.lexists(metadata) else None
    except ConfigError as error:
        raise ConfigError(f"{path}: cannot be read as a ROS 2 bag ({error})") from error
    bag = stated.get("rosbag2_bagfile_information") if isinstance(stated, Mapping) else None
    named = bag.get("relative_file_paths") if isinstance(bag, Mapping) else None
    files = [path / PurePath(str(name)).name for name in named] if isinstance(named, list) else []
    if bag is None or str(bag.get("compression_mode", "")).lower() != "file":
        for file in dict.fromkeys(files):
            check_file(file)
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="diffdrive-mpc-bag-") as name:
        copies = [_unpacked_file(file, Path(name)) for file in dict.fromkeys(files)]
        plain = {**bag, "compression_mode": "", "compression_format": "", "relative_file_paths": copies}
        plain.pop("files", None)
        (Path(name) / "metadata.yaml").write_text(
            yaml.safe_dump({"rosbag2_bagfile_information": plain}), encoding="utf-8"
        )
        for copy in copies:
            check_file(Path(name) / copy)
        yield Path(name)


def _unpacked_file(file: Path, folder: Path) -> str:
    """Unpack a file of a bag into a folder, within its budget; its name there."""
    from zstandard import ZstdDecompressor, ZstdError  # noqa: PLC0415 - only who reads bags needs it

    try:
        with open_input(file) as packed, (folder / file.stem).open("wb") as plain:
            budget = Budget(file, os.fstat(packed.fileno()).st_size)
            for block in ZstdDecompressor().read_to_iter(packed, write_size=_BLOCK):
                budget.take(len(block))
                if len(block) > shutil.disk_usage(folder).free:
                    raise ConfigError(f"{file}: there is no room to unpack it in {folder}")
                plain.write(block)
    except (OSError, ZstdError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{file}: cannot be unpacked ({reason})") from error
    return file.stem


def check_messages(path: Path, reader: Reader) -> None:
    """Raise ConfigError where the messages of a bag are packed one by one, and unpack to too much."""
    if reader.compression_mode != "message":
        return
    budget = Budget(path, sum(file.stat().st_size for file in path.iterdir() if file.is_file()))
    for storage in getattr(reader.storage, "storages", ()):
        for _, _, data in storage.messages(storage.connections):
            budget.take(len(unpacked(path, bytes(data), "zstd")))


def check_file(path: Path) -> None:
    """Raise ConfigError if a file of a bag is no regular file, or says or takes more than is read.

    What is wrong with it otherwise the library says that reads it.
    """
    try:
        with open_input(path) as file:
            state = os.fstat(file.fileno())
            _check_contents(path, (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns))
    except FileNotFoundError:
        return
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from error


@lru_cache(maxsize=16)
def _check_contents(path: Path, state: tuple[int, ...]) -> None:
    """Once for each state of a file; see `check_file`."""
    with open_input(path) as file:
        head, size = file.read(8), state[2]
        if head == _MCAP:
            _check_mcap(path, file, size)
        elif head == _ROS1:
            _check_ros1(path, file, size)
        elif head == _SQLITE:
            _check_sqlite(path, size)


def _check_mcap(path: Path, file: BinaryIO, size: int) -> None:
    """Records of an MCAP file: https://mcap.dev/spec."""
    budget, chunks, entries = Budget(path, size), dict[int, int](), list[tuple[int, int, int, int]]()
    at = 8
    while at + 9 <= size:
        file.seek(at)
        kind, length = struct.unpack("<BQ", file.read(9))
        if length > size - at - 9:
            return  # cut off: the library says so
        if kind == _CHUNK:
            chunks[at] = _check_chunk(path, file, length, budget)
        elif kind == _CHUNK_INDEX:
            if length < 32:
                raise _damaged(path, at)
            begin, end, place, whole = struct.unpack("<QQQQ", file.read(32))
            entries.append((begin, end, place, whole))
        at += 9 + length
    places = [place for _, _, place, _ in entries]
    if len(set(places)) < len(places) or not set(places) <= set(chunks):
        raise ConfigError(f"{path}: its index does not fit its chunks; `mcap recover` may save it")
    _check_open(path, [(begin, end, chunks[place]) for begin, end, place, _ in entries])


def _check_chunk(path: Path, file: BinaryIO, length: int, budget: Budget) -> int:
    """Bytes that the chunk at the file's place unpacks to."""
    at = file.tell() - 9
    if length < 40:
        raise _damaged(path, at)
    _, _, whole, _, name = struct.unpack("<QQQII", file.read(32))
    if name > length - 40:
        raise _damaged(path, at)
    how = file.read(name).decode("ascii", "replace")
    (packed,) = struct.unpack("<Q", file.read(8))
    if packed > length - 40 - name:
        raise _damaged(path, at)
    # What is not packed takes what it takes on the disk.
    least = len(unpacked(path, file.read(min(packed, MOST_UNPACKED + 1)), how, whole))
    budget.take(least if how else 0)
    return least


def _check_open(path: Path, chunks: list[tuple[int, int, int]]) -> None:
    """Raise ConfigError where chunks (begin, end, bytes) of one time are too large to be held together."""
    open_now, total = list[tuple[int, int]](), 0
    for begin, end, size in sorted(chunks):
        while open_now and open_now[0][0] < begin:
            total -= heapq.heappop(open_now)[1]
        heapq.heappush(open_now, (end, size))
        total += size
        if total > MOST_OPEN and len(open_now) > 1:
            raise ConfigError(
                f"{path}: chunks of the same time take more than {MOST_OPEN / MEGABYTE:g} MB unpacked; "
                "sort it (`mcap sort`)"
            )


def _check_ros1(path: Path, file: BinaryIO, size: int) -> None:
    """Records of a bag of ROS 1: http://wiki.ros.org/Bags/Format/2.0."""
    budget = Budget(path, size)
    file.seek(13)  # "#ROSBAG V2.0\n"
    while file.tell() + 8 <= size:
        at = file.tell()
        (header_size,) = struct.unpack("<I", file.read(4))
        if header_size > min(size - at - 8, MEGABYTE):
            return  # cut off, or no header: the library says so
        fields = _ros1_fields(file.read(header_size))
        (length,) = struct.unpack("<I", file.read(4))
        left = size - file.tell()
        if length > left:
            return
        if fields.get(b"op") == b"\x05":
            how = fields.get(b"compression", b"none").decode("ascii", "replace")
            # What is not packed is as long as it is; some recorders write 1 as its size, and no reader minds.
            whole = length if how == "none" else struct.unpack("<I", fields.get(b"size", b"").ljust(4, b"\0")[:4])[0]
            content = unpacked(path, file.read(min(length, MOST_UNPACKED + 1)), how, whole)
            budget.take(0 if how == "none" else len(content))
        file.seek(at + 8 + header_size + length)


def _ros1_fields(header: bytes) -> dict[bytes, bytes]:
    fields, at = dict[bytes, bytes](), 0
    while at + 4 <= len(header):
        (size,) = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + size].partition(b"=")
        fields[name] = value
        at += 4 + size
    return fields


def _check_sqlite(path: Path, size: int) -> None:
    """Kinds and sizes of what the data base of a bag holds."""
    import sqlite3  # noqa: PLC0415 - only who reads such bags needs it

    base = sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)
    try:
        if hasattr(base, "setlimit"):
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_UNPACKED)
        base.execute("PRAGMA trusted_schema = OFF")
        for table in ("messages", "topics"):
            # Columns that are worked out take no room in the file, and any in memory.
            if any(row[6] for row in base.execute(f"PRAGMA table_xinfo({table})")):
                raise ConfigError(f"{path}: the table '{table}' is not that of a bag; export it again")
        wrong = "typeof(timestamp) != 'integer' OR typeof(data) != 'blob' OR typeof(topic_id) != 'integer'"
        (count,) = base.execute(f"SELECT count(*) FROM messages WHERE {wrong}").fetchone()
        if count:
            raise ConfigError(
                f"{path}: {count} messages have a stamp that is no whole number of nanoseconds, or hold no bytes; "
                "export the bag again (`ros2 bag convert`)"
            )
        (total,) = base.execute("SELECT sum(length(data)) FROM messages").fetchone()
        Budget(path, size).take(total or 0)
    except sqlite3.Error as error:
        raise ConfigError(f"{path}: cannot be read as a ROS 2 bag ({error}); is it complete?") from error
    finally:
        base.close()


def _damaged(path: Path, at: int) -> ConfigError:
    return ConfigError(f"{path}: the record at byte {at} is damaged; `mcap recover` may save the file")


class WithinFile:
    """A file from which no more is asked than it holds: a length that a damaged file names is not allocated.

    Parameters
    ----------
    file
        Regular, and open for reading.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._left = os.fstat(file.fileno()).st_size - file.tell()

    def read(self, count: int = -1) -> bytes:
        """The next `count` bytes, or as many as there are."""
        block = self._file.read(self._left if count < 0 else min(count, self._left))
        self._left -= len(block)
        return block


def plain_chunk(path: Path, chunk: Any, budget: Budget) -> Any:  # noqa: ANN401 - a record of the mcap library
    """An MCAP chunk whose data are unpacked, within `budget`; raises ConfigError as `unpacked`."""
    from dataclasses import replace  # noqa: PLC0415

    data = unpacked(path, chunk.data, chunk.compression, chunk.uncompressed_size)
    budget.take(len(data) if chunk.compression else 0)
    return replace(chunk, data=data, compression="")
