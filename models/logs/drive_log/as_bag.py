"""The ROS messages in the file of a drive, as the readers of bags want them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple, Self

from diffdrive_mpc.models.logs.drive_log.reader import messages


class Connection(NamedTuple):
    """A topic, with the type and number of its messages."""

    topic: str
    msgtype: str
    msgcount: int


class DriveBag:
    """What is used of `rosbags.rosbag2.Reader`, for the file at `path`: its topics of ROS messages.

    Attributes
    ----------
    connections
        Its topics.
    duration
        From the first message to the last [ns].
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.connections: list[Connection] = []
        self.duration = 0

    def __enter__(self) -> Self:
        """Look for the topics."""
        seen: Counter[tuple[str, str]] = Counter()
        times = set()
        for kind, channel, message in messages(self._path):
            times.add(message.log_time)
            if channel.message_encoding == "cdr":
                seen[channel.topic, kind] += 1
        self.connections = [Connection(*named, count) for named, count in seen.items()]
        self.duration = max(times, default=0) - min(times, default=0)
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is held open."""

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """The messages of some topics: their topic, time of receipt [ns] and bytes."""
        wanted = {known.topic: known for known in connections}
        for _, channel, message in messages(self._path):
            if channel.topic in wanted:
                yield wanted[channel.topic], message.log_time, message.data
