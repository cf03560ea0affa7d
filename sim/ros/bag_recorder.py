"""Messages into a rosbag2, written with `rosbags`: no ROS recorder is needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from diffdrive_mpc.models.checked_yaml import ConfigError

Storage = Literal["mcap", "sqlite3"]
MessageRecorder = Callable[[str, Any, int], None]
"""Called with topic, message and time of receipt [ns]."""

_BAG_VERSION: Literal[9] = 9
"""Version of a bag's metadata that Jazzy writes."""


@contextmanager
def bag_recorder(folder: Path, storage: Storage = "mcap") -> Iterator[MessageRecorder]:
    """Open a new bag; whatever ends the context, what was recorded until then can be read.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is something at `folder` already, or it cannot be written.
    """
    from rclpy.serialization import serialize_message  # noqa: PLC0415 - --help does without ROS
    from rosbags.rosbag2 import StoragePlugin, Writer, WriterError  # noqa: PLC0415
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    if folder.exists():
        raise ConfigError(f"{folder}: is there already; give a folder that is not, or remove it")
    plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        writer = Writer(folder, version=_BAG_VERSION, storage_plugin=plugin)
        writer.open()
    except (OSError, WriterError) as error:
        raise ConfigError(f"{folder}: cannot be written to ({error})") from error
    store, connections = get_typestore(Stores.ROS2_JAZZY), {}

    def record(topic: str, message: Any, received: int) -> None:  # noqa: ANN401
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, _kind(message), typestore=store)
        writer.write(connections[topic], received, serialize_message(message))

    try:
        yield record
    finally:
        writer.close()


def _kind(message: Any) -> str:  # noqa: ANN401
    """The type of a message as ROS names it, such as nav_msgs/msg/Odometry."""
    kind = type(message)
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
