"""Bond with nav2_lifecycle_manager: both sides send heartbeats and detect the end of the other side.

The protocol is that of bondcpp. All bonds share a topic; `id` identifies the bond, and `instance_id` the side. Each
side waits for the other side, is alive while it receives heartbeats, and at its end announces the end until the other
side also ends.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile

from diffdrive_mpc.mpc.ros.conversions import message_type, subscribe_bounded
from diffdrive_mpc.mpc.ros.node_part import NodePart

TOPIC = "bond"
# Timeouts of bondcpp and of the nodes of Nav2 [s].
CONNECT_TIMEOUT, HEARTBEAT_TIMEOUT, DISCONNECT_TIMEOUT = 10.0, 4.0, 2.0


class BondState(StrEnum):
    """State of one side of a bond."""

    WAITING = "waiting for the lifecycle manager"
    ALIVE = "bound"
    LEAVING = "leaving"
    DEAD = "none"


class BondProtocol:
    """State machine of a side of a bond, independent of ROS messages.

    Parameters
    ----------
    send
        Function that sends a heartbeat; its argument is False if this side has ended.
    now
        Monotonic clock [s].

    Attributes
    ----------
    state
        State of the bond.
    end_reason
        Reason for the end of the other side; empty while that side is alive.
    """

    def __init__(self, send: Callable[[bool], None], now: Callable[[], float]) -> None:
        self._send, self._now = send, now
        self.state, self.end_reason = BondState.WAITING, ""
        self._since = now()

    def beat(self) -> None:
        """Update the bond; call once per period."""
        elapsed = self._now() - self._since
        if self.state is BondState.WAITING and elapsed > CONNECT_TIMEOUT:
            # No manager is present, so the node continues without a bond.
            self.state = BondState.DEAD
        elif self.state is BondState.ALIVE and elapsed > HEARTBEAT_TIMEOUT:
            self.state, self.end_reason = BondState.DEAD, f"no heartbeat for {HEARTBEAT_TIMEOUT:g} s"
        elif self.state is BondState.LEAVING and elapsed > DISCONNECT_TIMEOUT:
            self.state = BondState.DEAD
        if self.state in (BondState.WAITING, BondState.ALIVE):
            self._send(True)
        elif self.state is BondState.LEAVING:
            self._send(False)

    def receive(self, *, is_alive: bool) -> None:
        """Handle a message of the other side; `is_alive` is False if that side has ended."""
        if self.state is BondState.LEAVING:
            if not is_alive:
                self.state = BondState.DEAD
        elif self.state is not BondState.DEAD:
            if is_alive:
                self.state, self._since = BondState.ALIVE, self._now()
            else:
                self.state, self.end_reason = BondState.DEAD, "it ended the bond"
                self._send(False)

    def leave(self) -> None:
        """Send the end of this side to the other side."""
        if self.state is BondState.DEAD:
            return
        self.state = BondState.LEAVING if self.state is BondState.ALIVE else BondState.DEAD
        self._since = self._now()
        self._send(False)


class Bond:
    """Bond of an active node with the node's name as `id`; the executor of the control loop sends heartbeats.

    Parameters
    ----------
    node
        Node that owns the bond.
    period
        Period of the heartbeats [s].
    """

    def __init__(self, node: Node, period: float) -> None:
        kind = message_type("bond", "Status")
        if kind is None:
            raise ValueError("bond is not installed")
        self._node, self._type, self._period = node, kind, period
        self._id, self._instance = node.get_name(), str(uuid.uuid4())
        self._publisher = node.create_publisher(kind, TOPIC, QoSProfile(depth=5))
        self.protocol = BondProtocol(self._send_status, time.monotonic)
        self._subscription = subscribe_bounded(node, kind, TOPIC, self._receive, QoSProfile(depth=100), refuse=_ignore)
        self._timer = node.create_timer(period, self._beat, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._last_reason = ""
        self._is_closed = False

    @property
    def text(self) -> str:
        """State of the bond for diagnostics."""
        return ": ".join(filter(None, (self.protocol.state, self.protocol.end_reason)))

    def leave(self) -> None:
        """End the bond; the announcement is repeated until the manager confirms it."""
        self.protocol.leave()

    def close(self) -> None:
        """End the bond without waiting for a confirmation."""
        if self._is_closed:
            return
        self.protocol.leave()
        self._is_closed = True
        self._node.destroy_timer(self._timer)
        self._node.destroy_subscription(self._subscription)
        self._node.destroy_publisher(self._publisher)

    def _beat(self) -> None:
        self.protocol.beat()
        if self.protocol.end_reason and not self._last_reason:
            self._last_reason = self.protocol.end_reason
            self._node.get_logger().warning(f"lifecycle manager disconnected: {self._last_reason}; driving continues")

    def _receive(self, message: Any) -> None:  # noqa: ANN401 - ROS messages have no types to check
        if message.id == self._id and message.instance_id != self._instance:
            self.protocol.receive(is_alive=bool(message.active))

    def _send_status(self, is_alive: bool) -> None:
        message = self._type(id=self._id, instance_id=self._instance, active=is_alive)
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.heartbeat_timeout, message.heartbeat_period = HEARTBEAT_TIMEOUT, self._period
        self._publisher.publish(message)


def _ignore(_: str) -> None:
    """Ignore an invalid bond message, which does not count as a heartbeat."""


class BondPart(NodePart):
    """Bond of the active node with the lifecycle manager, if the message type is installed."""

    bond: Bond | None = None

    def activate(self) -> None:
        """Start a bond."""
        self._close()
        period = self.require_active()[1].settings.bond_heartbeat_period
        if not period:
            return
        if message_type("bond", "Status") is None:
            text = "no bond with a lifecycle manager: bond is not installed; set its bond_timeout to 0"
            self.node.get_logger().info(text)
            return
        self.bond = Bond(self.node, period)

    def deactivate(self) -> None:
        """End the bond; the announcement is repeated until the manager confirms it."""
        if self.bond is not None:
            self.bond.leave()

    def tear_down(self) -> None:
        """End the bond without waiting for the manager."""
        self._close()

    def diagnostics(self) -> Mapping[str, str]:
        """Return the state of the bond."""
        return {} if self.bond is None else {"bond": self.bond.text}

    def _close(self) -> None:
        if self.bond is not None:
            self.bond.close()
            self.bond = None
