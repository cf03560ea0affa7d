"""Reader of the topics and messages of a ROS 2 bag, file by file."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path, PurePath
from typing import Any, NamedTuple, Self

from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.input_file import open_input
from diffdrive_mpc.models.logs.bag_bounds import Budget, unpack
from diffdrive_mpc.models.logs.mcap_file import MCAP_MAGIC, McapChannel, McapMessage, mcap_content
from diffdrive_mpc.models.logs.sqlite_file import SQLITE_MAGIC, sqlite_messages

_METADATA = "metadata.yaml"
_ROS1 = b"#ROSBAG"
_ZSTD = b"\x28\xb5\x2f\xfd"


class Connection(NamedTuple):
    """A topic with its message type and number of messages."""

    topic: str
    msgtype: str
    msgcount: int


class Bag:
    """Bag, given by its folder or by one .mcap or .db3 file.

    Parameters
    ----------
    path
        The bag.

    Attributes
    ----------
    connections
        Topics of the bag. The number of messages is the maximum of the count in the files and in metadata.yaml.
    duration
        Time from the first message to the last [ns].

    Raises
    ------
    models.checked_yaml.ConfigError
        Raised on entry if a file exceeds a limit, is named twice, or is a ROS 1 bag.
    OSError, ValueError
        Raised on entry or while reading if a file is damaged or missing.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._files, self._is_packed = path, [path], False
        self.connections: list[Connection] = []
        self.duration = 0

    def __enter__(self) -> Self:
        """Count the messages of each topic."""
        stated_counts = self._read_metadata() if self._path.is_dir() else {}
        counts: Counter[tuple[str, str]] = Counter()
        first, last = None, 0
        for topic, kind, time, _ in self._messages(()):
            counts[topic, kind] += time is not None
            if time is not None:
                first, last = min(time, time if first is None else first), max(time, last)
        # A truncated file has fewer messages than metadata.yaml states; `read_topics` then reports the difference.
        self.connections = [
            Connection(topic, kind, max(count, stated_counts.get(topic, 0))) for (topic, kind), count in counts.items()
        ]
        self.duration = 0 if first is None else last - first
        return self

    def __exit__(self, *_: object) -> None:
        """End the context; no file is open between calls."""

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time of receipt [ns] and bytes of the messages of `connections`, in the order of the files."""
        selected = {(known.topic, known.msgtype) for known in connections}
        budget = Budget(self._path, sum(file.stat().st_size for file in self._files))
        for topic, kind, time, data in self._messages(selected):
            if time is not None and (topic, kind) in selected:
                content = bytes(data)
                if self._is_packed:
                    content = bytes(unpack(self._path, content, "zstd"))
                    budget.take(len(content))
                yield topic, time, content

    def _messages(
        self, selected: Collection[tuple[str, str]]
    ) -> Iterator[tuple[str, str, int | None, bytes | memoryview]]:
        for file in self._files:
            with open_input(file) as opened:
                head = opened.read(len(SQLITE_MAGIC))
            if head.startswith(SQLITE_MAGIC):
                yield from sqlite_messages(file, selected)
            elif head.startswith(MCAP_MAGIC):
                for content in mcap_content(file):
                    if isinstance(content, McapMessage) and content.channel.encoding == "cdr":
                        yield content.channel.topic, content.channel.kind, content.log_time, content.data
                    elif isinstance(content, McapChannel) and content.encoding == "cdr":
                        yield content.topic, content.kind, None, b""
            elif head.startswith(_ZSTD):
                raise ConfigError(f"{file}: the whole file is compressed; unpack it: `zstd -d {file.name}`")
            elif head.startswith(_ROS1):
                raise ConfigError(
                    f"{file}: this is a ROS 1 bag; convert it: `rosbags-convert --src {file.name} --dst {file.stem}`"
                )
            else:
                raise ValueError(f"'{file.name}' is not a bag" if head else f"'{file.name}' is empty")

    def _read_metadata(self) -> dict[str, int]:
        """Read the files of the bag and their compression; return the number of messages of each topic."""
        path = self._path / _METADATA
        if not os.path.lexists(path):
            raise ConfigError(f"{self._path}: the folder has no {_METADATA}; give the bag, or one of its files")
        try:
            content = read_yaml(path)
        except ConfigError as error:
            raise ConfigError(f"{self._path}: cannot be read as a ROS 2 bag ({error})") from error
        bag = content.get("rosbag2_bagfile_information") if isinstance(content, Mapping) else None
        paths = bag.get("relative_file_paths") if isinstance(bag, Mapping) else None
        if not isinstance(bag, Mapping) or not isinstance(paths, list) or not paths:
            raise ValueError(f"{_METADATA} names no files under 'relative_file_paths'")
        names = Counter(PurePath(str(name)).name for name in paths)
        name, count = names.most_common(1)[0]
        if count > 1:
            raise ConfigError(f"{path}: names the file '{name}' {count:,} times; name it once")
        if len(names) > file_limits().bag_files:
            raise ConfigError(
                f"{path}: names {len(names):,} files, the limit is {file_limits().bag_files:,}; merge them "
                "(`ros2 bag convert`)"
            )
        self._files = [self._path / name for name in names]
        # Links may give one file several names, and its messages would be read several times.
        inodes = {(state.st_dev, state.st_ino) for state in (file.stat() for file in self._files)}
        if len(inodes) < len(names):
            raise ConfigError(f"{path}: gives several names for one file; name each file once")
        mode = str(bag.get("compression_mode") or "").lower()
        self._is_packed = mode == "message"
        if mode == "file":
            raise ConfigError(f"{path}: its whole files are compressed; unpack the bag (`ros2 bag convert`)")
        if self._is_packed and bag.get("compression_format") != "zstd":
            raise ValueError(f"compression '{bag.get('compression_format')}' is not supported; use zstd")
        return _message_counts(bag.get("topics_with_message_count"))


def _message_counts(topics: Any) -> dict[str, int]:  # noqa: ANN401 - from a file
    """Return the stated number of messages by topic."""
    entries = [entry for entry in topics if isinstance(entry, Mapping)] if isinstance(topics, list) else []
    return {
        str(entry["topic_metadata"].get("name")): entry["message_count"]
        for entry in entries
        if isinstance(entry.get("topic_metadata"), Mapping) and isinstance(entry.get("message_count"), int)
    }
