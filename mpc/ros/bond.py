"""A bond with nav2_lifecycle_manager: both sides send heartbeats, and detect the end of the other.

The protocol is that of bondcpp: heartbeats on one topic, of all bonds; `id` names the bond, `instance_id` the side. A
side waits for its sister, lives while it receives heartbeats, and at its end announces it until the sister ends, too.
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
# As bondcpp has them, and Nav2's nodes set them [s].
CONNECT_TIMEOUT, HEARTBEAT_TIMEOUT, DISCONNECT_TIMEOUT = 10.0, 4.0, 2.0


class BondState(StrEnum):
    """State of one side of a bond."""

    WAITING = "waiting for the lifecycle manager"
    ALIVE = "bound"
    LEAVING = "leaving"
    DEAD = "none"


class BondProtocol:
    """One side of a bond, without its messages.

    Parameters
    ----------
    send
        Says whether this side lives.
    now
        A clock that never jumps [s].

    Attributes
    ----------
    state
        State of the bond.
    lost
        Why the sister is gone; empty while it is not.
    """

    def __init__(self, send: Callable[[bool], None], now: Callable[[], float]) -> None:
        self._send, self._now = send, now
        self.state, self.lost = BondState.WAITING, ""
        self._since = now()

    def beat(self) -> None:
        """Update the bond; call once per period."""
        passed = self._now() - self._since
        if self.state is BondState.WAITING and passed > CONNECT_TIMEOUT:
            # No manager is present, so the node continues alone.
            self.state = BondState.DEAD
        elif self.state is BondState.ALIVE and passed > HEARTBEAT_TIMEOUT:
            self.state, self.lost = BondState.DEAD, f"it was silent for {HEARTBEAT_TIMEOUT:g} s"
        elif self.state is BondState.LEAVING and passed > DISCONNECT_TIMEOUT:
            self.state = BondState.DEAD
        if self.state in (BondState.WAITING, BondState.ALIVE):
            self._send(True)
        elif self.state is BondState.LEAVING:
            self._send(False)

    def hear(self, *, lives: bool) -> None:
        """Handle a message of the sister, which states whether it lives."""
        if self.state is BondState.LEAVING:
            if not lives:
                self.state = BondState.DEAD
        elif self.state is not BondState.DEAD:
            if lives:
                self.state, self._since = BondState.ALIVE, self._now()
            else:
                self.state, self.lost = BondState.DEAD, "it has ended the bond"
                self._send(False)

    def leave(self) -> None:
        """End the bond."""
        if self.state is BondState.DEAD:
            return
        self.state = BondState.LEAVING if self.state is BondState.ALIVE else BondState.DEAD
        self._since = self._now()
        self._send(False)


class Bond:
    """A bond of an active node, which has the node's name; its heart beats in the node's executor, as its loop does.

    Parameters
    ----------
    node
        The node.
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
        self.protocol = BondProtocol(self._say, time.monotonic)
        self._subscription = subscribe_bounded(node, kind, TOPIC, self._hear, QoSProfile(depth=100), refuse=_ignore)
        self._timer = node.create_timer(period, self._beat, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._told = ""
        self._gone = False

    @property
    def words(self) -> str:
        """Its state, for diagnostics."""
        return f"{self.protocol.state}: {self.protocol.lost}" if self.protocol.lost else str(self.protocol.state)

    def leave(self) -> None:
        """End the bond: announce it now, and repeat it until the manager confirms."""
        self.protocol.leave()

    def close(self) -> None:
        """End the bond without waiting for a confirmation."""
        if self._gone:
            return
        self.protocol.leave()
        self._gone = True
        self._node.destroy_timer(self._timer)
        self._node.destroy_subscription(self._subscription)
        self._node.destroy_publisher(self._publisher)

    def _beat(self) -> None:
        self.protocol.beat()
        if self.protocol.lost and not self._told:
            self._told = self.protocol.lost
            self._node.get_logger().warning(f"the lifecycle manager is gone: {self.protocol.lost}; driving continues")

    def _hear(self, message: Any) -> None:  # noqa: ANN401 - ROS messages have no types to check
        if message.id == self._id and message.instance_id != self._instance:
            self.protocol.hear(lives=bool(message.active))

    def _say(self, lives: bool) -> None:
        message = self._type(id=self._id, instance_id=self._instance, active=lives)
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.heartbeat_timeout, message.heartbeat_period = HEARTBEAT_TIMEOUT, self._period
        self._publisher.publish(message)


def _ignore(_: str) -> None:
    """Ignore an invalid bond message: it is no heartbeat."""


class BondPart(NodePart):
    """Bond of the active node with the lifecycle manager, if its type is installed."""

    bond: Bond | None = None

    def activate(self) -> None:
        """Start a bond."""
        self._close()
        period = self.running()[1].settings.bond_heartbeat_period
        if not period:
            return
        if message_type("bond", "Status") is None:
            words = "no bond with a lifecycle manager: bond is not installed; set its bond_timeout to 0"
            self.node.get_logger().info(words)
            return
        self.bond = Bond(self.node, period)

    def deactivate(self) -> None:
        """End the bond; it announces the end until the manager has confirmed it."""
        if self.bond is not None:
            self.bond.leave()

    def tear_down(self) -> None:
        """End the bond without waiting for the manager."""
        self._close()

    def diagnostics(self) -> Mapping[str, str]:
        """Return the state of the bond."""
        return {} if self.bond is None else {"bond": self.bond.words}

    def _close(self) -> None:
        if self.bond is not None:
            self.bond.close()
            self.bond = None
