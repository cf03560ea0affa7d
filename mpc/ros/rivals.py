"""Detection of other publishers on the command and input topics."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from std_msgs.msg import Empty

from diffdrive_mpc.mpc.ros.command_output import command_topic
from diffdrive_mpc.mpc.ros.control_loop import ControlLoop, LoopTick, RefusedError
from diffdrive_mpc.mpc.ros.conversions import process_pending
from diffdrive_mpc.mpc.ros.node_part import NodePart, NodeTools
from diffdrive_mpc.mpc.ros.publishers import NAMELESS, full_name, mismatched_subscribers, publishers_of
from diffdrive_mpc.mpc.ros.topic_watch import TopicWatch

_CLAIM = "_diffdrive_mpc"
"""Suffix of the topic by which active nodes of this project detect each other; nodes publish no messages on it."""
_POLL = 0.02
"""Period of the checks while the node waits for the discovery of other nodes [s]."""
_NAME_TIMEOUT = 4.0
"""Maximum time from the discovery of a publisher to the discovery of its node's name [s]."""
_PERIOD = 0.2
"""Period of the checks for other publishers while the node is active [s]."""


class OtherPublishers(NamedTuple):
    """Full names of other nodes that publish commands.

    Attributes
    ----------
    project
        Other active nodes of this project that send commands to the same topic.
    foreign
        All other nodes that publish on the topic, including inactive nodes of this project.
    """

    project: tuple[str, ...]
    foreign: tuple[str, ...]


class Rivals:
    """Detector of other command publishers, which also announces `node` to other nodes of this project.

    Parameters
    ----------
    node
        Node with a publisher on `topic`.
    topic
        Topic of the commands, before remapping.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self.topic = node.resolve_topic_name(topic)
        self._created_at = time.monotonic()
        self._claim: Publisher | None = None

    def claim(self, wait: float) -> OtherPublishers:
        """Claim the topic and return the other publishers.

        The function waits until the node has existed for `wait` [s], since the middleware needs time to discover other
        publishers. Two nodes that claim the topic at the same time detect each other.
        """
        if self._claim is None:
            # The claim precedes the first check, so that two nodes cannot miss each other.
            self._claim = self._node.create_publisher(Empty, f"{self.topic}/{_CLAIM}", 1)
        rivals = self.others()
        start = time.monotonic()
        while (not rivals.project and time.monotonic() - self._created_at < wait) or (
            NAMELESS in rivals.project and time.monotonic() - start < _NAME_TIMEOUT
        ):
            time.sleep(_POLL)
            rivals = self.others()
        return rivals

    def release(self) -> None:
        """Release the topic."""
        if self._claim is not None:
            self._node.destroy_publisher(self._claim)
            self._claim = None

    def others(self) -> OtherPublishers:
        """Return the other discovered publishers on the topic."""
        project = self._other_publishers(f"{self.topic}/{_CLAIM}", is_included=self._claim is not None)
        foreign = self._other_publishers(self.topic, is_included=True)
        for name in project:
            if name in foreign:
                # A node of this project also publishes on the command topic itself.
                foreign.remove(name)
        return OtherPublishers(tuple(project), tuple(foreign))

    def _other_publishers(self, topic: str, *, is_included: bool) -> list[str]:
        names = sorted(map(full_name, self._node.get_publishers_info_by_topic(topic)))
        name = self._node.get_fully_qualified_name()
        # If `is_included`, one publisher with this name belongs to this node; the rest belong to other nodes.
        if is_included and name in names:
            names.remove(name)
        return names


def describe_shared_input(node: Node, watch: TopicWatch, topic: str) -> str:
    """Describe the publishers that share an input, and the remedy; empty if there is only one publisher.

    The middleware may list a killed node for some time. Two publishers with the same name are therefore reported only
    if both send messages, or if the middleware does not number messages.
    """
    infos, series = node.get_publishers_info_by_topic(topic), watch.series
    names = sorted({*map(full_name, infos)} - {NAMELESS})
    if len(names) < 2:
        if len({bytes(info.endpoint_gid) for info in infos}) < 2:
            series.restart()
            return ""
        if series.is_numbered and not series.is_shared:
            return ""
    publishers = _names(names) if len(names) > 1 else f"two publishers of {_names(names) or NAMELESS}"
    return f"{publishers} publish on {topic}, and their messages cannot be distinguished; stop all but one"


def describe_rivals(others: OtherPublishers, topic: str) -> str:
    """Describe the conflict with other active nodes of this project; empty if there is no conflict."""
    if not others.project:
        return ""
    return f"{_names(others.project)} of this project also sends commands on {topic}; deactivate one of them"


def describe_foreign(others: OtherPublishers, topic: str) -> str:
    """Describe the other publishers; empty if there are none."""
    return f"{_names(others.foreign)} also publishes on {topic}" if others.foreign else ""


def _names(names: Sequence[str]) -> str:
    return " and ".join(names)


class RivalWatch(NodePart):
    """Checks for other nodes that publish commands or inputs, or subscribe to commands with the wrong type."""

    rivals: Rivals | None = None
    _timer: Any = None
    _was_input_shared = False

    def configure(self, tools: NodeTools) -> None:
        """Prepare the claim of the command topic."""
        self.rivals = Rivals(self.node, command_topic(tools.settings))

    def check_activation(self) -> None:
        """Claim the command topic; raise RefusedError if the node must not drive the robot."""
        assert self.rivals is not None
        assert self.tools is not None
        others = self.rivals.claim(self.tools.settings.discovery_wait)
        stop_reason = self._find_stop_reason(self.tools, self.rivals, others)
        if not stop_reason and self.tools.settings.exclusive_inputs:
            self._await_inputs(self.tools)
            stop_reason = self._find_stop_reason(self.tools, self.rivals, others)
        if stop_reason:
            self.rivals.release()
            raise RefusedError(stop_reason)

    def activate(self) -> None:
        """Check for other publishers now and periodically."""
        self._check_others()
        self._timer = self.node.create_timer(_PERIOD, self._check_others, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def tick(self, tick: LoopTick) -> None:  # noqa: ARG002 - argument of the base class
        """Check for other publishers immediately if two publishers send messages of an input."""
        is_shared = self.tools is not None and any(watch.series.is_shared for watch, _ in self.tools.inputs)
        if is_shared and not self._was_input_shared:
            self._check_others()
        self._was_input_shared = is_shared

    def deactivate(self) -> None:
        """Release the command topic."""
        self.node.destroy_timer(self._timer)
        if self.rivals is not None:
            self.rivals.release()

    def tear_down(self) -> None:
        """Release the command topic."""
        if self.rivals is not None:
            self.rivals.release()
            self.rivals = None

    def _find_stop_reason(self, tools: NodeTools, rivals: Rivals, others: OtherPublishers) -> str:
        """Return the reason why the node must not drive the robot; empty if it may drive."""
        stop_reason = describe_rivals(others, rivals.topic)
        if not stop_reason and others.foreign and tools.settings.exclusive_cmd_vel:
            stop_reason = f"{describe_foreign(others, rivals.topic)}; stop that node, or set exclusive_cmd_vel to false"
        if not stop_reason and tools.settings.exclusive_inputs:
            stop_reason = self._shared_input(tools)
        return stop_reason

    def _shared_input(self, tools: NodeTools) -> str:
        shared = (describe_shared_input(self.node, watch, topic.topic_name) for watch, topic in tools.inputs)
        return next(filter(None, shared), "")

    def _await_inputs(self, tools: NodeTools) -> None:
        """Receive messages of inputs with several publishers until two have sent messages, or until the time limit."""

        def shared() -> list[Subscription]:
            return [topic for _, topic in tools.inputs if self.node.count_publishers(topic.topic_name) > 1]

        end = time.monotonic() + tools.settings.discovery_wait
        while shared() and not any(watch.series.is_shared for watch, _ in tools.inputs) and time.monotonic() < end:
            for subscription in shared():
                process_pending(subscription)
            time.sleep(_POLL)

    def _check_others(self) -> None:
        """Update `stop_reason` and `warning` of the loop, which brakes if there is a stop reason."""
        if self.loop is None or self.tools is None or self.rivals is None:
            return
        loop, tools, topic = self.loop, self.tools, self.rivals.topic
        others, previous = self.rivals.others(), (loop.stop_reason, loop.warning)
        loop.stop_reason = self._find_stop_reason(tools, self.rivals, others)
        warnings = (
            "" if loop.stop_reason else describe_foreign(others, topic),
            # With exclusive inputs, a shared input is already a stop reason.
            "" if loop.stop_reason or tools.settings.exclusive_inputs else self._shared_input(tools),
            mismatched_subscribers(self.node, topic, stamped=tools.settings.stamped),
            self._clock_warning(loop, tools),
        )
        loop.warning = "; ".join(filter(None, warnings))
        if (loop.stop_reason, loop.warning) != previous and (loop.stop_reason or loop.warning):
            self.node.get_logger().warning("; ".join(filter(None, (loop.stop_reason, loop.warning))))
        for watch, subscription in tools.inputs:
            watch.source = "" if watch.accepted else publishers_of(self.node, subscription)

    def _clock_warning(self, loop: ControlLoop, tools: NodeTools) -> str:
        """Return a warning if the simulated clock does not advance in steps of the period."""
        if not (self.node.get_parameter("use_sim_time").value and loop.times.is_off_period):
            return ""
        return (
            "the simulated clock does not advance in steps of this node's sample_time, "
            f"{1e3 * tools.controller.config.sample_time:.4g} ms: "
            "start the simulated robot with the same configuration (sim-robot --config FILE)"
        )
