"""Publication of commands as twists, or as wheel speeds for a base without a twist input."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64MultiArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.ros.conversions import time_message, twist_message
from diffdrive_mpc.mpc.ros.settings import NodeSettings

TWISTS, WHEELS = "cmd_vel", "wheel_commands"
"""Topics of twist commands and of wheel commands, before remapping."""


def command_topic(settings: NodeSettings) -> str:
    """Return the topic of the commands, before remapping."""
    return WHEELS if settings.command_output == "wheels" else TWISTS


class CommandOutput(Protocol):
    """Output of commands to the base."""

    def send(self, command: FloatArray, time: int) -> None:
        """Send `command` (2,) v [m/s], omega [rad/s] of the tick at `time` [ns]."""

    def wait(self, seconds: float) -> None:
        """Wait for the acknowledgement of the last command, for at most `seconds` [s]."""

    def destroy(self) -> None:
        """Destroy the publisher."""


def command_output(
    node: LifecycleNode, settings: NodeSettings, config: Callable[[], ControllerConfig]
) -> CommandOutput:
    """Create the output selected by `settings`; `config` returns the current configuration of the controller."""
    if settings.command_output == "wheels":
        return _WheelOutput(node, settings, config)
    return _TwistOutput(node, settings)


class _Output:
    """Reliable lifecycle publisher of depth 1, which publishes only while the node is active."""

    def __init__(self, node: LifecycleNode, kind: type[Any], topic: str) -> None:
        self._node = node
        self._publisher = node.create_lifecycle_publisher(kind, topic, QoSProfile(depth=1))

    def wait(self, seconds: float) -> None:
        self._publisher.wait_for_all_acked(Duration(seconds=seconds))

    def destroy(self) -> None:
        self._node.destroy_lifecycle_publisher(self._publisher)


class _TwistOutput(_Output):
    def __init__(self, node: LifecycleNode, settings: NodeSettings) -> None:
        super().__init__(node, TwistStamped if settings.stamped else Twist, TWISTS)
        self._settings = settings

    def send(self, command: FloatArray, time: int) -> None:
        twist = twist_message(command)
        if not self._settings.stamped:
            self._publisher.publish(twist)
            return
        message = TwistStamped(twist=twist)
        message.header.stamp, message.header.frame_id = time_message(time), self._settings.base_frame
        self._publisher.publish(message)


class _WheelOutput(_Output):
    """Output of the angular speeds of the wheels [rad/s], in the order of the joints of the ros2_control controller."""

    def __init__(self, node: LifecycleNode, settings: NodeSettings, config: Callable[[], ControllerConfig]) -> None:
        super().__init__(node, Float64MultiArray, WHEELS)
        self._radius, self._half_track, self._config = settings.wheel_radius, 0.5 * config().wheels.track, config
        # In a left turn, the right wheels are faster.
        self._signs = [1.0 if side == "right" else -1.0 for side in settings.wheel_sides.split(",")]

    def send(self, command: FloatArray, time: int) -> None:  # noqa: ARG002 - the message has no stamp
        v, omega = float(command[0]), float(command[1])
        rim_speed = abs(v) + self._half_track * abs(omega)
        # The same factor slows all wheels, which preserves the curvature. The limit may change while driving.
        factor = min(1.0, self._config().limits.wheel_speed / rim_speed) if rim_speed > 0.0 else 1.0
        speeds = [factor * (v + sign * self._half_track * omega) / self._radius for sign in self._signs]
        self._publisher.publish(Float64MultiArray(data=speeds))
