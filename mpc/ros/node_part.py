"""Base class of features of the node, with hooks that the node calls.

A package registers a subclass of `NodePart` as an entry point of the group `diffdrive_mpc.node_parts`. The name of the
entry point is the name of the part and the prefix of its parameters, `parts.<name>.<key>`. The node loads the parts in
its settings, and the parts with the name of a configured feature of the controller.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeVar

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from diffdrive_mpc.models.logs.drive_log.tick import Cell
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.ros.control_loop import ControlLoop, LoopTick, RefusedError
from diffdrive_mpc.mpc.ros.conversions import SENSOR_BYTES, subscribe_bounded
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.publishers import Publishers
from diffdrive_mpc.mpc.ros.settings import NodeSettings, PartSettings
from diffdrive_mpc.mpc.ros.side_process import SideProcess
from diffdrive_mpc.mpc.ros.topic_watch import TopicWatch
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.planned.planned_path import PlannedPath

_Settings = TypeVar("_Settings", bound=PartSettings)


class PathCheck(Protocol):
    """Condition that paths of `follow_path` must satisfy; it is pickled for the side process."""

    def plan(
        self,
        plan: Callable[[TrajectoryLimits], PlannedPath],
        config: ControllerConfig,
        speed: float,
        limits: TrajectoryLimits,
    ) -> PlannedPath:
        """Return a planned path that satisfies the condition.

        Parameters
        ----------
        plan
            Function that plans the path within limits of speed and acceleration.
        config
            Configuration of the controller.
        speed
            Current speed of the robot [m/s].
        limits
            Limits of speed and acceleration without this condition.

        Raises
        ------
        ConfigError
            If no path within the limits satisfies the condition.
        """
        ...


@dataclass(frozen=True)
class NodeTools:
    """Objects of a configured node that its parts share."""

    settings: NodeSettings
    controller: Controller
    inbox: Inbox
    publishers: Publishers
    side_process: SideProcess
    inputs: Sequence[tuple[TopicWatch, Subscription]]
    """Watches of the controller's inputs with their subscriptions."""

    def part_settings(self, schema: type[_Settings]) -> _Settings:
        """Return the settings of the part with this schema."""
        return next(group for group in self.settings.parts.values() if isinstance(group, schema))


class PartHost(LifecycleNode):
    """Lifecycle node with attached parts.

    Attributes
    ----------
    label
        Label of the lifecycle state.
    parts
        Parts by name, in the order in which their hooks are called.
    """

    label: str
    parts: dict[str, NodePart]

    def configure_parts(self, tools: NodeTools) -> None:
        """Pass the tools to the parts and configure them."""
        for part in self.parts.values():
            part.tools = tools
            part.configure(tools)

    def activate_parts(self, loop: ControlLoop) -> None:
        """Pass the loop to the parts and activate them."""
        for part in self.parts.values():
            part.loop = loop
            part.activate()

    def deactivate_parts(self) -> None:
        """Remove the loop from the parts and deactivate them."""
        for part in self.parts.values():
            part.loop = None
            part.deactivate()

    def tear_down_parts(self) -> None:
        """Remove the tools from the parts, and destroy their objects."""
        for part in self.parts.values():
            part.tools = None
            part.tear_down()
            part.unsubscribe()


class NodePart:
    """Feature of the node; a subclass overrides the hooks that it needs.

    A part is constructed together with its node and can therefore offer services in every lifecycle state.

    Parameters
    ----------
    node
        Node to which the part belongs.

    Attributes
    ----------
    schema
        Schema of the part's parameters; None for a built-in part, which uses `NodeSettings`.
    tools
        Objects of the configured node; None while the node is unconfigured.
    loop
        Control loop of the active node; None while the node is not active.
    topics
        Watches of the part's inputs, which diagnostics include.
    """

    schema: ClassVar[type[PartSettings] | None] = None

    def __init__(self, node: PartHost) -> None:
        self.node = node
        self.tools: NodeTools | None = None
        self.loop: ControlLoop | None = None
        self.topics: Sequence[TopicWatch] = ()
        self._subscriptions: list[Subscription] = []

    def configure(self, tools: NodeTools) -> None:
        """Build the objects that need the configured node; raise ValueError to refuse the transition."""

    def check_activation(self) -> None:
        """Raise ValueError if the node must not become active."""

    def activate(self) -> None:
        """Prepare for the first tick of an activation."""

    def deactivate(self) -> None:
        """Clean up after an activation, after the last command was sent."""

    def tear_down(self) -> None:
        """Destroy the objects that `configure` built; some may be missing if `configure` failed."""

    def change_limits(self) -> None:
        """Apply changed weights or limits of the active controller."""

    def tick(self, tick: LoopTick) -> None:
        """Handle the result of a tick before its command is sent."""

    def after_tick(self, tick: LoopTick, time: int, row: dict[str, Cell]) -> None:
        """Handle a tick at `time` [ns] after its command was sent, and add columns to the `row` of the recording."""

    def path_check(self) -> PathCheck | None:
        """Return the condition on paths of `follow_path`; None if there is no condition."""
        return None

    def diagnostics(self) -> Mapping[str, str]:
        """Return values for diagnostics by name."""
        return {}

    @property
    def fault(self) -> str:
        """Warning for diagnostics; empty if there is no warning."""
        return ""

    def after_diagnostics(self, message: DiagnosticArray, time: int) -> None:
        """Handle a diagnostics message that was published at `time` [ns]."""

    # Methods for subclasses.

    def require_tools(self) -> NodeTools:
        """Return the tools of the configured node."""
        assert self.tools is not None
        return self.tools

    def require_active(self) -> tuple[ControlLoop, NodeTools]:
        """Return loop and tools of the active node; raise RefusedError if it is not active."""
        if self.loop is None or self.tools is None:
            raise RefusedError(f"the node is {self.node.label}; activate it first")
        return self.loop, self.tools

    def subscribe(
        self,
        kind: type[Any],
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile | int,
        refuse: Callable[[str], None],
        max_bytes: int = SENSOR_BYTES,
    ) -> None:
        """Subscribe to messages of at most `max_bytes` until the part is torn down, see `subscribe_bounded`."""
        subscription = subscribe_bounded(self.node, kind, topic, callback, qos, refuse=refuse, max_bytes=max_bytes)
        self._subscriptions.append(subscription)

    def subscribe_raw(
        self, kind: type[Any], topic: str, callback: Callable[[bytes], None], qos: QoSProfile | int = 1
    ) -> None:
        """Subscribe to serialised messages until the part is torn down."""
        self._subscriptions.append(self.node.create_subscription(kind, topic, callback, qos, raw=True))

    def unsubscribe(self) -> None:
        """Destroy the subscriptions."""
        for subscription in self._subscriptions:
            self.node.destroy_subscription(subscription)
        self._subscriptions.clear()
