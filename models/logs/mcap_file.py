"""An MCAP file read from its beginning: no index is trusted, and one chunk is unpacked at a time.

Records: https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple, TypeAlias
from zlib import crc32

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.input_file import MEGABYTE, open_input
from diffdrive_mpc.models.logs.bag_bounds import MOST_UNPACKED, Budget, unpacked

MCAP_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0C, 0x0F
_KINDS = (_SCHEMA, _CHANNEL, _MESSAGE, _METADATA)
_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_LONGEST_NAME = 10_000


class McapChannel(NamedTuple):
    """Channel: its topic, the name of its message type, and the encoding of its messages."""

    topic: str
    kind: str
    encoding: str


class McapMessage(NamedTuple):
    """Message with its channel and time of receipt [ns]."""

    channel: McapChannel
    log_time: int
    data: bytes | memoryview


class McapMetadata(NamedTuple):
    """Words by key, under a name."""

    name: str
    values: dict[str, str]


McapContent: TypeAlias = McapChannel | McapMessage | McapMetadata


def mcap_content(path: Path) -> Iterator[McapContent]:
    """Yield channels, messages and metadata in the order of the file.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file or a chunk unpacks to more than is read.
    ValueError
        If a record is damaged, or the file ends before its data do.
    OSError
        If the file cannot be opened.
    """
    kinds: dict[int, str] = {}
    channels: dict[int, McapChannel] = {}
    for kind, record in _records(path):
        try:
            if kind == _MESSAGE:
                number, _, time, _ = _MESSAGE_HEAD.unpack_from(record)
                if number not in channels:
                    raise ValueError(f"a message is of channel {number}, which is not there")
                yield McapMessage(channels[number], time, record[_MESSAGE_HEAD.size :])
            elif kind == _SCHEMA:
                (number,) = struct.unpack_from("<H", record)
                kinds[number], _ = _text(record, 2)
            elif kind == _CHANNEL:
                number, schema = struct.unpack_from("<HH", record)
                topic, offset = _text(record, 4)
                encoding, _ = _text(record, offset)
                channels[number] = McapChannel(topic, kinds.get(schema, ""), encoding)
                yield channels[number]
            else:
                name, offset = _text(record, 0)
                yield McapMetadata(name, _words(record, offset))
        except (struct.error, UnicodeDecodeError) as error:
            raise ValueError("a record of schema, channel, message or metadata is damaged") from error


def _text(record: memoryview, offset: int, longest: int = _LONGEST_NAME) -> tuple[str, int]:
    """Read a text with its length before it; return it and the place behind it."""
    (length,) = struct.unpack_from("<I", record, offset)
    end = offset + 4 + length
    if end > len(record) or length > longest:
        raise ValueError(f"a name of {length:,} bytes is longer than its record, or than {longest:,}")
    return bytes(record[offset + 4 : end]).decode("utf-8"), end


def _words(record: memoryview, offset: int) -> dict[str, str]:
    (length,) = struct.unpack_from("<I", record, offset)
    offset, end, words = offset + 4, offset + 4 + length, dict[str, str]()
    while offset < end:
        key, offset = _text(record, offset)
        words[key], offset = _text(record, offset, MOST_UNPACKED)
    return words


def _records(path: Path) -> Iterator[tuple[int, memoryview]]:
    """Yield kind and content of every record of `_KINDS` up to the end of the data, those inside of chunks included."""
    with open_input(path) as file:
        budget = Budget(path, os.fstat(file.fileno()).st_size)
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise ValueError("it does not begin as an MCAP file")
        while True:
            kind, length = _HEAD.unpack(_exactly(file, _HEAD.size))
            if kind in (_DATA_END, _FOOTER):
                return
            if kind == 0:
                raise ValueError("a record contains only zeros")
            if kind not in (*_KINDS, _CHUNK):
                while length > 0:
                    length -= len(_exactly(file, min(length, MEGABYTE)))
                continue
            if length > MOST_UNPACKED + MEGABYTE:
                raise ConfigError(
                    f"{path}: a chunk or message of {length / MEGABYTE:,.0f} MB, at most "
                    f"{MOST_UNPACKED / MEGABYTE:g} are read; record it in smaller chunks"
                )
            record = memoryview(_exactly(file, length))
            if kind == _CHUNK:
                yield from _inside(_chunk(path, record, budget))
            else:
                yield kind, record


def _exactly(stream: IO[bytes], count: int) -> bytes:
    data = stream.read(count)
    if len(data) < count:
        raise ValueError("it ends before its data do")
    return data


def _chunk(path: Path, record: memoryview, budget: Budget) -> memoryview:
    """Return the records of a chunk, within the budget if they are packed."""
    try:
        _, _, size, checksum, name = struct.unpack_from("<QQQII", record)
        how = bytes(record[32 : 32 + name]).decode("ascii")
        (packed,) = struct.unpack_from("<Q", record, 32 + name)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError("the head of a chunk is damaged") from error
    data = record[40 + name :]
    if len(data) != packed:
        raise ValueError(f"a chunk says that it has {packed:,} bytes, and has {len(data):,}")
    content = unpacked(path, data, how, size)
    budget.take(len(content) if how else 0)
    if checksum and crc32(content) != checksum:
        raise ValueError("the checksum of a chunk is not that of its content")
    return memoryview(content)


def _inside(chunk: memoryview) -> Iterator[tuple[int, memoryview]]:
    offset, whole = 0, len(chunk)
    while offset < whole:
        if offset + _HEAD.size > whole:
            raise ValueError("a record in a chunk is cut off")
        kind, length = _HEAD.unpack_from(chunk, offset)
        start = offset + _HEAD.size
        offset = start + length
        if offset > whole:
            raise ValueError("a record in a chunk is longer than the chunk")
        if kind in _KINDS:
            yield kind, chunk[start:offset]
