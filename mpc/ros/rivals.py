"""Who else publishes on the topic of the commands, and who on the inputs, each of which has to have one voice."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Empty

_CLAIM = "_diffdrive_mpc"
"""Below the topic of the commands: whoever of this project drives by it has a publisher there, which never sends."""
_POLL = 0.02
_UNKNOWN = "_UNKNOWN_"
"""In the name of a node whose publisher was found before it; it takes so long at most until both are [s]."""
_CHRISTENING = 4.0
_NAMELESS = "a node not known by name yet"


class Others(NamedTuple):
    """Full names of nodes.

    Attributes
    ----------
    project
        Other active nodes of this project that send commands to the same topic.
    foreign
        Others that publish on it; a node of this project that is not active is one of them.
    """

    project: tuple[str, ...]
    foreign: tuple[str, ...]


class Rivals:
    """Looks who publishes commands beside `node`, and lets other nodes of this project know that it does.

    Parameters
    ----------
    node
        The node; it has a publisher on `topic`.
    topic
        Of the commands, before remapping.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self.topic = node.resolve_topic_name(topic)
        self._born = time.monotonic()
        self._claim: Publisher | None = None

    def claim(self, wait: float) -> Others:
        """Claim the topic, and say who is there; a node younger than `wait` [s] waits until it has that age.

        Until then the middleware may not have found the others. Two that claim at the same time see each other.
        """
        if self._claim is None:
            self._claim = self._node.create_publisher(Empty, f"{self.topic}/{_CLAIM}", 1)
        rivals = self.others()
        began = time.monotonic()
        while (not rivals.project and time.monotonic() - self._born < wait) or (
            _NAMELESS in rivals.project and time.monotonic() - began < _CHRISTENING
        ):
            time.sleep(_POLL)
            rivals = self.others()
        return rivals

    def release(self) -> None:
        """Let others have it."""
        if self._claim is not None:
            self._node.destroy_publisher(self._claim)
            self._claim = None

    def others(self) -> Others:
        """Who publishes there beside the node itself, as far as the middleware knows by now."""
        project = self._beside_own(f"{self.topic}/{_CLAIM}")
        foreign = self._beside_own(self.topic)
        for name in project:
            if name in foreign:
                foreign.remove(name)
        return Others(tuple(project), tuple(foreign))

    def _beside_own(self, topic: str) -> list[str]:
        names = _publishing(self._node, topic)
        own = self._node.get_fully_qualified_name()
        # One of that name is this node; a second one is another.
        if own in names:
            names.remove(own)
        return names


def _publishing(node: Node, topic: str) -> list[str]:
    """Full names of the nodes that publish on `topic`, one for each publisher."""
    return sorted(
        _NAMELESS if _UNKNOWN in each.node_name else f"{each.node_namespace.rstrip('/')}/{each.node_name}"
        for each in node.get_publishers_info_by_topic(topic)
    )


def speak_together(node: Node, topics: Iterable[str]) -> str:
    """Which nodes publish on the same input, and what to do; empty where each input has one voice.

    A node that was started again has the name of the one before, which the middleware may take a while to forget.
    """
    for topic in topics:
        names = sorted(set(_publishing(node, topic)) - {_NAMELESS})
        if len(names) > 1:
            return f"{_names(names)} publish on {topic}, and nobody knows whose message is true; stop all but one"
    return ""


def drive_too(others: Others, topic: str) -> str:
    """What is wrong with other nodes of this project that drive, and what to do; empty where there are none."""
    if not others.project:
        return ""
    return f"{_names(others.project)} of this project drives by {topic} too; deactivate one of them"


def publish_too(others: Others, topic: str) -> str:
    """Who else publishes; empty where nobody does."""
    return f"{_names(others.foreign)} publishes on {topic} too" if others.foreign else ""


def _names(names: Sequence[str]) -> str:
    return " and ".join(names)
