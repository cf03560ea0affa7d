"""Sequential reader of MCAP files that needs no index and unpacks one chunk at a time.

Format of the records: https://mcap.dev/spec.
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
from diffdrive_mpc.models.logs.bag_bounds import MAX_UNPACKED, Budget, unpack

MCAP_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0C, 0x0F
_KINDS = (_SCHEMA, _CHANNEL, _MESSAGE, _METADATA)
# Opcode and length of a record; channel, sequence number, log time and publish time of a message.
_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_MAX_NAME = 10_000


class McapChannel(NamedTuple):
    """Channel with topic, message type and encoding of its messages."""

    topic: str
    kind: str
    encoding: str


class McapMessage(NamedTuple):
    """Message with its channel and time of receipt [ns]."""

    channel: McapChannel
    log_time: int
    data: bytes | memoryview


class McapMetadata(NamedTuple):
    """Metadata record: name, and values by key."""

    name: str
    values: dict[str, str]


McapContent: TypeAlias = McapChannel | McapMessage | McapMetadata


def mcap_content(path: Path) -> Iterator[McapContent]:
    """Yield channels, messages and metadata in the order of the file.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the unpacked file or a chunk exceeds its limit.
    ValueError
        If a record is damaged or the file is truncated.
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
                    raise ValueError(f"a message belongs to channel {number}, which does not exist")
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
                yield McapMetadata(name, _text_map(record, offset))
        except (struct.error, UnicodeDecodeError) as error:
            raise ValueError("a record of schema, channel, message or metadata is damaged") from error


def _text(record: memoryview, offset: int, max_length: int = _MAX_NAME) -> tuple[str, int]:
    """Read a length-prefixed string at `offset`; return the string and the offset of its end."""
    (length,) = struct.unpack_from("<I", record, offset)
    end = offset + 4 + length
    if end > len(record) or length > max_length:
        raise ValueError(f"a text of {length:,} bytes exceeds its record or the limit of {max_length:,}")
    return bytes(record[offset + 4 : end]).decode("utf-8"), end


def _text_map(record: memoryview, offset: int) -> dict[str, str]:
    (length,) = struct.unpack_from("<I", record, offset)
    offset, end, values = offset + 4, offset + 4 + length, dict[str, str]()
    while offset < end:
        key, offset = _text(record, offset)
        values[key], offset = _text(record, offset, MAX_UNPACKED)
    return values


def _records(path: Path) -> Iterator[tuple[int, memoryview]]:
    """Yield kind and content of the records of `_KINDS` up to the end of the data, including those in chunks."""
    with open_input(path) as file:
        budget = Budget(path, os.fstat(file.fileno()).st_size)
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise ValueError("it is not an MCAP file")
        while True:
            kind, length = _HEAD.unpack(_read_exactly(file, _HEAD.size))
            if kind in (_DATA_END, _FOOTER):
                return
            if kind == 0:
                raise ValueError("a record contains only zeros")
            if kind not in (*_KINDS, _CHUNK):
                # Skip in blocks, because a forged length must not allocate memory.
                while length > 0:
                    length -= len(_read_exactly(file, min(length, MEGABYTE)))
                continue
            if length > MAX_UNPACKED + MEGABYTE:
                raise ConfigError(
                    f"{path}: a chunk or message has {length / MEGABYTE:,.0f} MB, the limit is "
                    f"{MAX_UNPACKED / MEGABYTE:g}; record it in smaller chunks"
                )
            record = memoryview(_read_exactly(file, length))
            if kind == _CHUNK:
                yield from _chunk_records(_chunk(path, record, budget))
            else:
                yield kind, record


def _read_exactly(stream: IO[bytes], count: int) -> bytes:
    data = stream.read(count)
    if len(data) < count:
        raise ValueError("it is truncated")
    return data


def _chunk(path: Path, record: memoryview, budget: Budget) -> memoryview:
    """Return the unpacked records of a chunk; compressed chunks count towards the budget."""
    try:
        _, _, size, checksum, name = struct.unpack_from("<QQQII", record)
        compression = bytes(record[32 : 32 + name]).decode("ascii")
        (packed,) = struct.unpack_from("<Q", record, 32 + name)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError("the head of a chunk is damaged") from error
    # The name of the compression follows 32 bytes; then 8 bytes with the size of the packed records.
    data = record[40 + name :]
    if len(data) != packed:
        raise ValueError(f"a chunk declares {packed:,} bytes and has {len(data):,}")
    content = unpack(path, data, compression, size)
    # Records that are not compressed cannot exceed the size of the file.
    budget.take(len(content) if compression else 0)
    if checksum and crc32(content) != checksum:
        raise ValueError("the checksum of a chunk does not match its content")
    return memoryview(content)


def _chunk_records(chunk: memoryview) -> Iterator[tuple[int, memoryview]]:
    offset, size = 0, len(chunk)
    while offset < size:
        if offset + _HEAD.size > size:
            raise ValueError("a record in a chunk is truncated")
        kind, length = _HEAD.unpack_from(chunk, offset)
        start = offset + _HEAD.size
        offset = start + length
        if offset > size:
            raise ValueError("a record in a chunk is longer than the chunk")
        if kind in _KINDS:
            yield kind, chunk[start:offset]
