"""A bag of ROS 1 read from its beginning: http://wiki.ros.org/Bags/Format/2.0. Its index is not used."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from diffdrive_mpc.models.input_file import MEGABYTE, open_input
from diffdrive_mpc.models.logs.bag_bounds import MOST_UNPACKED, Budget, unpacked

ROS1_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = b"\x02", b"\x05", b"\x07"
_LONGEST_NAME = 10_000

_Fields = dict[bytes, bytes]


def ros1_messages(path: Path) -> Iterator[tuple[str, str, int | None, bytes]]:
    """Yield topic, type, time of receipt [ns] and bytes of every message; of a topic itself once, without a time.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a chunk unpacks to more than is read.
    ValueError
        If a record is damaged, or the file ends within one.
    OSError
        If the file cannot be opened.
    """
    topics: dict[int, tuple[str, str]] = {}
    for fields, data in _records(path):
        kind = fields.get(b"op")
        if kind == _CONNECTION:
            number, topic = _number(fields, b"conn"), _name(fields, b"topic")
            if number not in topics:
                topics[number] = topic, _ros2_name(_name(_fields(data), b"type"))
                yield *topics[number], None, b""
        elif kind == _MESSAGE:
            number, stamp = _number(fields, b"conn"), fields.get(b"time", b"")
            if number not in topics or len(stamp) != 8:
                raise ValueError(f"a message has no time, or is of connection {number}, which is not there")
            seconds, nanoseconds = struct.unpack("<II", stamp)
            yield *topics[number], seconds * 10**9 + nanoseconds, data


def _ros2_name(kind: str) -> str:
    package, slash, name = kind.partition("/")
    return f"{package}/msg/{name}" if slash and "/" not in name else kind


def _number(fields: _Fields, name: bytes) -> int:
    return int.from_bytes(fields.get(name, b"")[:4], "little")


def _name(fields: _Fields, name: bytes) -> str:
    text = fields.get(name, b"")
    if not 0 < len(text) <= _LONGEST_NAME:
        raise ValueError(f"a connection has a {name.decode()} of {len(text):,} bytes")
    return text.decode("utf-8")


def _records(path: Path) -> Iterator[tuple[_Fields, bytes]]:
    """Yield fields and data of connections and messages, in chunks and outside of them."""
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(ROS1_MAGIC)) != ROS1_MAGIC:
            raise ValueError("it does not begin as a bag of ROS 1, version 2.0")
        budget = Budget(path, size)
        for fields, length in _heads(file, size):
            kind = fields.get(b"op")
            if kind == _CHUNK:
                how = fields.get(b"compression", b"none").decode("ascii", "replace")
                # What is not packed is as long as it is; some recorders write 1 as its size, and no reader minds.
                whole = length if how == "none" else _number(fields, b"size")
                content = unpacked(path, file.read(min(length, MOST_UNPACKED + 1)), how, whole)
                budget.take(0 if how == "none" else len(content))
                inner = BytesIO(content)
                for inner_fields, inner_length in _heads(inner, len(content)):
                    if inner_fields.get(b"op") in (_CONNECTION, _MESSAGE):
                        yield inner_fields, inner.read(inner_length)
            elif kind in (_CONNECTION, _MESSAGE):
                yield fields, file.read(length)


def _heads(file: BinaryIO, size: int) -> Iterator[tuple[_Fields, int]]:
    """Yield the fields of each record and the length of its data, which begin at the file's place."""
    while (offset := file.tell()) < size:
        (header,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
        if header > min(size - offset - 8, MEGABYTE):
            raise ValueError(f"the record at byte {offset:,} is damaged or cut off")
        fields = _fields(file.read(header))
        if b"op" not in fields:
            raise ValueError(f"the record at byte {offset:,} has no kind")
        (length,) = struct.unpack("<I", file.read(4))
        end = offset + 8 + header + length
        if end > size:
            raise ValueError(f"the record at byte {offset:,} is cut off")
        yield fields, length
        file.seek(end)


def _fields(header: bytes) -> _Fields:
    fields, offset = _Fields(), 0
    while offset + 4 <= len(header):
        (size,) = struct.unpack_from("<I", header, offset)
        name, _, value = header[offset + 4 : offset + 4 + size].partition(b"=")
        fields[name] = value
        offset += 4 + size
    return fields
