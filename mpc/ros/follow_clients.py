"""Clients of the action `follow_path`: identify the client of a goal, and check that it is alive."""

from __future__ import annotations

import time
from collections.abc import Sequence

import rclpy
from nav2_msgs.action import FollowPath
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

_STALL = 0.2
"""Time without acknowledgement after which a participant is created [s]; live clients acknowledge within 0.1 s."""
_DISCOVERY = 1.0
"""Time for a new participant to discover the live clients before another one is created [s]; usually 0.15 s."""


class _Link:
    """Publisher of feedback in the participant of `node`; `context` is given if the participant is separate."""

    def __init__(self, node: Node, action: str, context: Context | None = None) -> None:
        self.node, self._context = node, context
        self._requests = f"rq{action}/_action/send_goalRequest"
        # In a full queue the writer requests an acknowledgement with each sample: a queue of one is always full.
        self.publisher = node.create_publisher(
            FollowPath.Impl.FeedbackMessage, f"{action}/_action/feedback", QoSProfile(depth=1)
        )

    def clients(self) -> frozenset[bytes]:
        """Return the GIDs of the clients known to the participant."""
        writers = self.node.get_publishers_info_by_topic(self._requests, no_mangle=True)
        return frozenset(bytes(writer.endpoint_gid) for writer in writers)

    def destroy(self) -> None:
        self.node.destroy_publisher(self.publisher)
        if self._context is not None:
            self.node.destroy_node()
            self._context.try_shutdown()


class ClientWatch:
    """Publisher of feedback that monitors its acknowledgement by the clients.

    The middleware of a live client acknowledges feedback automatically. All clients subscribe to one topic. After a
    client has died, no sample counts as acknowledged until its participant lease expires (Fast DDS: 20 s). A new
    participant discovers live clients only: if there are several subscriptions, feedback continues through a new
    participant.

    Parameters
    ----------
    node
        Node of the action server.
    action
        Resolved name of the action.
    """

    def __init__(self, node: Node, action: str) -> None:
        self._node, self._action = node, action
        self._graph = self._link = _Link(node, action)
        self._goals_sent: dict[bytes, int] = {}
        self._last_answer = self._renewed_at = time.monotonic()
        self._acknowledges = True

    def claim(self, number: int) -> frozenset[bytes]:
        """Return the clients that may have sent the goal whose request has sequence number `number`.

        Each client numbers its requests from one, and rclpy does not expose the client's identity. The result has
        several clients if they have sent the same number of goals. It is empty if the middleware does not name request
        topics like DDS.
        """
        known = self._graph.clients()
        clients = frozenset(client for client in known if self._goals_sent.get(client) == number - 1)
        clients = clients or known - self._goals_sent.keys() or known
        clients = clients & self._link.clients() or clients
        if len(clients) == 1:
            self._goals_sent[min(clients)] = number
        return clients

    def check(self, goals: Sequence[frozenset[bytes]]) -> list[bool]:
        """Return for each goal, a set of clients, True if all of them have acknowledged the last feedback."""
        now, acknowledged = time.monotonic(), self._is_acknowledged()
        present = self._link.clients()
        subscribed = self._link.publisher.get_subscription_count() > 0
        alive = [acknowledged and subscribed and clients <= present for clients in goals]
        if all(alive):
            self._last_answer = now
        elif now - self._last_answer > _STALL and now - self._renewed_at > _DISCOVERY and self._is_ambiguous():
            self._renewed_at = now
            self._renew()
        return alive

    def send(self, message: FollowPath.Impl.FeedbackMessage) -> None:
        """Publish feedback."""
        self._link.publisher.publish(message)

    def destroy(self) -> None:
        """Destroy the publishers."""
        if self._link is not self._graph:
            self._link.destroy()
        self._graph.destroy()

    def _is_acknowledged(self) -> bool:
        if not self._acknowledges:
            return True
        try:
            return self._link.publisher.wait_for_all_acked(Duration())
        except RuntimeError as error:  # the base of rclpy's errors, which have no public names
            self._acknowledges = False
            self._node.get_logger().warning(
                f"{self._action}: this middleware does not report acknowledgements ({' '.join(str(error).split())}): "
                "the robot follows the goal of a killed client until the middleware's lease expires"
            )
            return True

    def _is_ambiguous(self) -> bool:
        """Return True if the missing acknowledgement may be that of a subscription other than the goal's client."""
        return self._acknowledges and self._node.count_subscribers(self._graph.publisher.topic_name) > 1

    def _renew(self) -> None:
        name, namespace = self._node.get_name(), self._node.get_namespace()
        # With SROS 2 the participant uses the same keys, and creates only topics that their policy allows.
        nodes = self._node.get_node_names_and_namespaces_with_enclaves()
        enclave = next(entry[2] for entry in nodes if entry[:2] == (name, namespace))
        context = Context()
        context.init(
            args=["--ros-args", "--enclave", enclave],
            initialize_logging=False,
            domain_id=self._node.context.get_domain_id(),
        )
        node = rclpy.create_node(
            f"{name}_feedback",
            context=context,
            namespace=namespace,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=[Parameter("start_type_description_service", value=False)],
        )
        former, self._link = self._link, _Link(node, self._action, context)
        if former is not self._graph:
            former.destroy()
