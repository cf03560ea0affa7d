"""Publishers of the node, except for diagnostics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Vector3Stamped
from nav_msgs.msg import Odometry, Path
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import String
from visualization_msgs.msg import Marker

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.logs.drive_log.topics import DRIVE, path_times
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.ros.command_output import command_output
from diffdrive_mpc.mpc.ros.control_loop import LoopTick
from diffdrive_mpc.mpc.ros.conversions import pose_message, stamped_pose_message, time_message, twist_message
from diffdrive_mpc.mpc.ros.reference_input import tracking_error
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.step_result import Mode, StepResult

# Subscribers that start later also receive the last message.
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Time limit for the acknowledgement of the last command when the node stops [s].
_STOP_TIMEOUT = 0.3
_LINE_WIDTH = 0.02
_GREEN, _RED = (0.1, 0.8, 0.2), (0.9, 0.1, 0.1)


class Publishers:
    """Lifecycle publishers of the node, which publish only while the node is active.

    Parameters
    ----------
    node
        Node that owns the publishers.
    settings
        Settings of the node.
    config
        Function that returns the current configuration of the controller.
    frame
        Control frame.
    """

    def __init__(
        self, node: LifecycleNode, settings: NodeSettings, config: Callable[[], ControllerConfig], frame: str
    ) -> None:
        self._node, self._settings, self._frame = node, settings, frame
        create = node.create_lifecycle_publisher
        self._command = command_output(node, settings, config)
        self._estimate = EstimateOutput(node, settings, frame)
        self._predicted_path = create(Path, "~/predicted_path", 1)
        self._reference_path = create(Path, "~/reference_path", _LATCHED)
        self._marker = create(Marker, "~/error_marker", 1)
        self._error = create(Vector3Stamped, "~/tracking_error", 10)
        self._mode = create(String, "~/mode", _LATCHED)
        self._tick, self._drive = create(String, "~/tick", 100), create(String, "~/drive", _LATCHED)
        self._last_mode = ""

    def destroy(self) -> None:
        """Destroy all publishers."""
        self._command.destroy()
        self._estimate.destroy()
        subscribed = (self._predicted_path, self._reference_path, self._marker, self._error, self._mode)
        for publisher in (*subscribed, self._tick, self._drive):
            self._node.destroy_lifecycle_publisher(publisher)

    def command(self, command: FloatArray, time: int) -> None:
        """Send `command` (2,) v [m/s], omega [rad/s] of the tick at `time` [ns]."""
        self._command.send(command, time)

    def stop(self, time: int) -> None:
        """Send zero, and wait for its acknowledgement for a limited time."""
        self.command(np.zeros(2), time)
        self._command.wait(_STOP_TIMEOUT)

    def mode(self, tick: LoopTick) -> None:
        """Publish and log mode and message after a change of the mode."""
        if tick.mode != self._last_mode:
            self._last_mode = tick.mode
            text = f"{tick.mode}: {tick.message}" if tick.message else tick.mode
            self._mode.publish(String(data=text))
            self._node.get_logger().info(text)

    @property
    def has_recorder(self) -> bool:
        """True if the topic of the tick records has a subscriber."""
        return bool(self._tick.get_subscription_count())

    def record(self, lines: Sequence[tuple[str, str]]) -> None:
        """Publish `lines`, pairs of topic and text, on the topics of ticks and drives."""
        for topic, line in lines:
            (self._drive if topic == DRIVE else self._tick).publish(String(data=line))

    def error(self, result: StepResult, time: int) -> None:
        """Publish the estimate and the tracking error: x along, y across [m], z heading [rad]."""
        self._estimate.send(result.estimate, time)
        error = tracking_error(result)
        if error is None or not self._error.get_subscription_count():
            return
        message = Vector3Stamped()
        message.header.stamp, message.header.frame_id = time_message(time), self._settings.base_frame
        message.vector.x, message.vector.y, message.vector.z = error
        self._error.publish(message)

    def reference(self, reference: Reference, start: int, time: int) -> None:
        """Publish the path of `reference` with the start time `start` [ns], also to subscribers that start later."""
        times = path_times(reference.duration)
        stamps = start + np.round(times * 1e9).astype(np.int64)
        self._reference_path.publish(self._path(reference.sample(times).pose, stamps.tolist(), time))

    def visuals(self, result: StepResult, period: int, time: int) -> None:
        """Publish the predicted path, with a pose per `period` [ns], and the marker, if they have subscribers."""
        if result.plan is not None and self._predicted_path.get_subscription_count():
            stamps = (time + period * index for index in range(len(result.plan)))
            self._predicted_path.publish(self._path(result.plan, stamps, time))
        if result.reference is not None and result.estimate is not None and self._marker.get_subscription_count():
            self._marker.publish(self._line(result.estimate.pose, result.reference[0], result.mode, time))

    def _path(self, poses: FloatArray, stamps: Iterable[int], time: int) -> Path:
        path = Path(
            poses=[stamped_pose_message(pose, stamp, self._frame) for pose, stamp in zip(poses, stamps, strict=True)]
        )
        path.header.stamp, path.header.frame_id = time_message(time), self._frame
        return path

    def _line(self, robot: FloatArray, reference: FloatArray, mode: Mode, time: int) -> Marker:
        """Build a line from the robot to the tracked pose, green in normal operation."""
        marker = Marker(ns="tracking_error", type=Marker.LINE_STRIP, action=Marker.ADD)
        marker.header.stamp, marker.header.frame_id = time_message(time), self._frame
        marker.scale.x = _LINE_WIDTH
        marker.color.r, marker.color.g, marker.color.b = _GREEN if mode is Mode.TRACKING else _RED
        marker.color.a = 1.0
        marker.points = [Point(x=float(pose[0]), y=float(pose[1])) for pose in (robot, reference)]
        return marker


_PACKAGE = "geometry_msgs/msg/"
# Part of the node name that rclpy returns until the node is discovered.
_UNKNOWN = "_UNKNOWN_"
NAMELESS = "a node whose name is not known yet"
_COMMANDS = {"TwistStamped": "stamped:=true", "Twist": "stamped:=false"}


def mismatched_subscribers(node: Node, topic: str, *, stamped: bool) -> str:
    """Describe the subscribers of `topic` with a wrong command type, and the remedy; empty if there are none."""
    used, wrong = ("TwistStamped", "Twist") if stamped else ("Twist", "TwistStamped")
    mismatched = [info for info in node.get_subscriptions_info_by_topic(topic) if info.topic_type == _PACKAGE + wrong]
    if not mismatched:
        return ""
    return (
        f"{_names(mismatched)} subscribes to {topic} with type {wrong} and does not receive this node's {used}: set "
        f"the parameter {_COMMANDS[wrong]}"
    )


def publishers_of(node: Node, subscription: Subscription) -> str:
    """Describe topic, type and reliability of `subscription`, and the publishers on its topic."""
    topic, kind = subscription.topic_name, subscription.msg_type
    infos = node.get_publishers_info_by_topic(topic)
    kind_name = f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
    subscriber = f"{topic}, {kind_name}, {_reliability(subscription.qos_profile)}"
    if not infos:
        return f"{subscriber}: no publisher; is the base running, and is the topic remapped (-r name:=/base/name)?"
    publishers = "; ".join(
        f"{_names([info])} publishes {info.topic_type}, {_reliability(info.qos_profile)}"
        + ("" if info.topic_type == kind_name else ", which is a different type")
        for info in infos
    )
    return f"{subscriber}: {publishers}"


def _reliability(qos: Any) -> str:  # noqa: ANN401 - the QoS profile of rclpy has no types
    return "best effort" if qos.reliability == ReliabilityPolicy.BEST_EFFORT else "reliable"


def _names(infos: Sequence[Any]) -> str:
    return " and ".join(sorted({full_name(info) for info in infos}))


def full_name(info: Any) -> str:  # noqa: ANN401 - rclpy has no types
    """Return the full name of the node of a publisher or subscription; `NAMELESS` until it is discovered."""
    return NAMELESS if _UNKNOWN in info.node_name else f"{info.node_namespace.rstrip('/')}/{info.node_name}"


ESTIMATE = "~/estimate"
# Rows of x, y, yaw, and of forward speed and yaw rate, in the 6 x 6 covariances of ROS.
_POSE, _TWIST = (0, 1, 5), (0, 5)


class EstimateOutput:
    """Publisher of the estimate, including slip, which publishes only if there are subscribers.

    Parameters
    ----------
    node
        Node that owns the publishers.
    settings
        Settings of the node.
    frame
        Control frame.
    """

    def __init__(self, node: LifecycleNode, settings: NodeSettings, frame: str) -> None:
        self._node, self._base, self._frame = node, settings.base_frame, frame
        self._publisher = node.create_lifecycle_publisher(Odometry, ESTIMATE, 10)

    def send(self, estimate: Estimate | None, time: int) -> None:
        """Publish the estimate of the tick at `time` [ns]; do nothing if there is no estimate."""
        if estimate is None or not self._publisher.get_subscription_count():
            return
        message = Odometry(child_frame_id=self._base)
        message.header.stamp, message.header.frame_id = time_message(time), self._frame
        message.pose.pose = pose_message(estimate.pose)
        message.pose.covariance = _covariance(estimate.pose_deviation, _POSE)
        message.twist.twist = twist_message(estimate.twist)
        message.twist.covariance = _covariance(estimate.twist_deviation, _TWIST)
        self._publisher.publish(message)

    def destroy(self) -> None:
        """Destroy the publisher."""
        self._node.destroy_lifecycle_publisher(self._publisher)


def _covariance(deviation: FloatArray, rows: tuple[int, ...]) -> list[float]:
    """Build the covariance (36,) from standard deviations of the given rows; correlations are zero."""
    diagonal = np.zeros(6)
    diagonal[list(rows)] = np.square(deviation)
    return [float(value) for value in np.diag(diagonal).ravel()]
