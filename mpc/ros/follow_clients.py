"""Identification of the client of a `follow_path` goal, and check that the client is alive."""

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
"""Time without acknowledgement after which a new participant is created [s]; live clients need less than 0.1 s."""
_DISCOVERY = 1.0
"""Minimum time between the creation of two participants [s]; discovery of the live clients usually takes 0.15 s."""


class _Link:
    """Publisher of feedback in the participant of `node`; `context` is the context of a separate participant."""

    def __init__(self, node: Node, action: str, context: Context | None = None) -> None:
        self.node, self._context = node, context
        self._requests = f"rq{action}/_action/send_goalRequest"
        # A writer with a full queue requests an acknowledgement with each sample; a queue of depth 1 is full at once.
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

    The middleware of a live client acknowledges feedback automatically. All clients subscribe to the same topic. If one
    client dies, no sample counts as acknowledged until the lease of its participant expires (20 s with Fast DDS). A new
    participant discovers only live clients, so if there are several subscriptions, feedback continues through a new
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
        self._last_acknowledged = self._renewed_at = time.monotonic()
        self._reports_acknowledgements = True

    def claim(self, number: int) -> frozenset[bytes]:
        """Return the clients that may have sent the goal request with the sequence number `number`.

        Each client numbers its requests from 1, and rclpy does not expose the identity of the client. The result
        contains all clients that have sent the same number of goals. It is empty if the middleware does not use the
        topic names of DDS for requests.
        """
        known_clients = self._graph.clients()
        clients = frozenset(client for client in known_clients if self._goals_sent.get(client) == number - 1)
        clients = clients or known_clients - self._goals_sent.keys() or known_clients
        clients = clients & self._link.clients() or clients
        # The number of goals is certain only if there is a single candidate.
        if len(clients) == 1:
            self._goals_sent[min(clients)] = number
        return clients

    def check(self, goals: Sequence[frozenset[bytes]]) -> list[bool]:
        """Return True for each goal whose clients are all alive: all have acknowledged the last feedback."""
        now, acknowledged = time.monotonic(), self._is_acknowledged()
        present = self._link.clients()
        subscribed = self._link.publisher.get_subscription_count() > 0
        alive = [acknowledged and subscribed and clients <= present for clients in goals]
        if all(alive):
            self._last_acknowledged = now
        elif now - self._last_acknowledged > _STALL and now - self._renewed_at > _DISCOVERY and self._is_ambiguous():
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
        if not self._reports_acknowledgements:
            return True
        try:
            return self._link.publisher.wait_for_all_acked(Duration())
        except RuntimeError as error:  # base class of the errors of rclpy, which have no public names
            self._reports_acknowledgements = False
            self._node.get_logger().warning(
                f"{self._action}: this middleware does not report acknowledgements ({' '.join(str(error).split())}): "
                "the robot follows the goal of a killed client until the middleware's lease expires"
            )
            return True

    def _is_ambiguous(self) -> bool:
        """Return True if the missing acknowledgement may belong to another subscription."""
        return self._reports_acknowledgements and self._node.count_subscribers(self._graph.publisher.topic_name) > 1

    def _renew(self) -> None:
        """Replace the publisher by a publisher in a new participant."""
        name, namespace = self._node.get_name(), self._node.get_namespace()
        # With SROS 2 the participant uses the keys of the node, and creates only topics that its policy allows.
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
        old_link, self._link = self._link, _Link(node, self._action, context)
        if old_link is not self._graph:
            old_link.destroy()
