"""Who is at the other end of the node's topics: the wrong type of message, or nobody at all, in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription

_PACKAGE = "geometry_msgs/msg/"
_UNKNOWN = "_UNKNOWN_"
_COMMANDS = {"TwistStamped": "stamped:=true", "Twist": "stamped:=false"}


def deaf_to_commands(node: Node, topic: str, *, stamped: bool) -> str:
    """Return which node listens on `topic` to another type of command than is sent, with the remedy; empty if none."""
    sent, other = ("TwistStamped", "Twist") if stamped else ("Twist", "TwistStamped")
    deaf = [info for info in node.get_subscriptions_info_by_topic(topic) if info.topic_type == _PACKAGE + other]
    if not deaf:
        return ""
    return (
        f"{_names(deaf)} listens on {topic} to {other} and cannot hear this node's {sent}: set the parameter "
        f"{_COMMANDS[other]}"
    )


def publishers_of(node: Node, subscription: Subscription) -> str:
    """Return topic, type and reliability that `subscription` asks for, and who publishes on that topic."""
    topic, kind = subscription.topic_name, _type_name(subscription.msg_type)
    infos = node.get_publishers_info_by_topic(topic)
    asked = f"{topic}, {kind}, {_reliability(subscription.qos_profile)}"
    if not infos:
        return f"{asked}: nobody publishes there; is the base running, and the topic remapped (-r name:=/base/name)?"
    words = "; ".join(
        f"{_names([info])} publishes {info.topic_type}, {_reliability(info.qos_profile)}"
        + ("" if info.topic_type == kind else ", which is another type")
        for info in infos
    )
    return f"{asked}: {words}"


def _type_name(kind: type[Any]) -> str:
    package, *_ = kind.__module__.split(".")
    return f"{package}/msg/{kind.__name__}"


def _reliability(qos: Any) -> str:  # noqa: ANN401 - rclpy's profile has no types
    return "best effort" if qos.reliability == ReliabilityPolicy.BEST_EFFORT else "reliable"


def _names(infos: Sequence[Any]) -> str:
    names = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos}
    return " and ".join(sorted("a node not known by name yet" if _UNKNOWN in name else name for name in names))
