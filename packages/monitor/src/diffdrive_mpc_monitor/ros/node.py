"""ROS node of the monitor: it subscribes to commands and publishes the checked commands on another topic."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry, Path
from pydantic import Field
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException, ParameterNotDeclaredException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu
from std_msgs.msg import String
from std_srvs.srv import Trigger

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, check
from diffdrive_mpc.models.suggestions import suggestion
from diffdrive_mpc_monitor.judge import Judge
from diffdrive_mpc_monitor.rules import load_rules
from diffdrive_mpc_monitor.senders import Senders

# ROS messages to plain numbers and back: the monitor's own, so that no mistake of the controller's is made twice.


Message = Any
"""Type of ROS messages, which have no type annotations."""


def seconds(stamp: Message) -> float:
    """Convert a stamp to seconds."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def planar(pose: Message) -> tuple[float, float, float]:
    """Extract (3,) x [m], y [m], yaw [rad] from a pose; NaN for an invalid orientation."""
    q = pose.orientation
    norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if not abs(norm - 1.0) < 0.02:
        return (math.nan, math.nan, math.nan)
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    return (pose.position.x, pose.position.y, yaw)


def command(twist: tuple[float, float], stamp: Message, frame: str, *, stamped: bool) -> Message:
    """Build the message of a command v [m/s], omega [rad/s]."""
    plain = Twist()
    plain.linear.x, plain.angular.z = twist
    if not stamped:
        return plain
    message = TwistStamped(twist=plain)
    message.header.stamp, message.header.frame_id = stamp, frame
    return message


# Settings of the node, without the rules.


class MonitorSettings(StrictModel, strict=True):
    """Topics, frames and monitored signals; these are the ROS parameters of the node, which are read at start-up."""

    rules: str = Field("default", min_length=1, description="name of shipped rules, or path of a YAML file [-]")
    controller: str = Field(
        "diffdrive_mpc",
        min_length=1,
        description="name of the controller's node, which publishes reference_path and mode",
    )
    stamped: bool = Field(True, description="true: commands are TwistStamped; false: Twist [-]")
    use_pose_topic: bool = Field(
        False, description="true: references are in map_frame, with poses on `pose`; false: in odom_frame [-]"
    )
    use_imu: bool = Field(True, description="true: the yaw rate is that of `imu`; false: of the wheels [-]")
    odom_frame: str = Field("odom", min_length=1, description="required frame_id of odometry [-]")
    map_frame: str = Field("map", min_length=1, description="required frame_id of poses [-]")
    base_frame: str = Field("base_link", min_length=1, description="required child_frame_id of odometry [-]")
    exclusive: bool = Field(
        True,
        description="stop the robot if another node publishes on `cmd_vel`, or two nodes publish on one input [-]",
    )


UNCHECKED, CHECKED = "cmd_vel_unchecked", "cmd_vel"
"""Topics of commands: from the controller, and to the base."""
PASSING, STOPPED = "PASSING", "STOPPED"
"""States on `~/state`; the reason follows after a colon."""
_PERIOD = 0.02
# Period of the search for other publishers of commands, and of the diagnostics [s].
_GRAPH_PERIOD, _DIAGNOSTICS_PERIOD = 0.5, 1.0
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_STANDING_MODES = frozenset({"IDLE", "PAUSED", "FAULT", "STOPPED", "FINISHED", "unconfigured", "inactive", "finalized"})
# Prefix of parameters that ROS declares, some of them after start-up.
_OF_ROS = "qos_overrides."
# Time limit for the delivery of the last command at shutdown [s].
_SHUTDOWN_TIME = 0.3


def _unknown(name: str) -> str:
    return f"unknown parameter {name!r}{suggestion(MonitorSettings, [name])}"


class MonitorNode(Node):
    """Node that forwards commands while all rules hold, and otherwise stops the robot until a person resets it.

    Parameters
    ----------
    defaults
        Defaults of the parameters.
    **options
        Options of `rclpy.node.Node`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the rules or a parameter are invalid.
    models.compiled.compiler.NotCompiledError
        If the library of the judge is missing.
    """

    def __init__(self, defaults: MonitorSettings | None = None, **options: Any) -> None:  # noqa: ANN401
        super().__init__("monitor", **options)
        self._settings = settings = self._read_parameters(defaults or MonitorSettings())
        self._rules = load_rules(settings.rules).with_sensors(pose=settings.use_pose_topic, gyro=settings.use_imu)
        self._judge = Judge(self._rules, self._now)
        self._published_state = self._rivals = ""
        self._shared_inputs: set[str] = set()
        kind = TwistStamped if settings.stamped else Twist
        newest = QoSProfile(depth=1)
        self._checked = self.create_publisher(kind, CHECKED, newest)
        self._state = self.create_publisher(String, "~/state", _LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # The queue is long, because every command must be checked.
        self._subscribe(kind, UNCHECKED, self._take_command, QoSProfile(depth=50))
        self._subscribe(Odometry, "odom", self._take_odometry, qos_profile_sensor_data)
        self.create_subscription(Path, f"{settings.controller}/reference_path", self._take_reference, _LATCHED)
        self.create_subscription(String, f"{settings.controller}/mode", self._take_mode, _LATCHED)
        if settings.use_imu:
            self._subscribe(Imu, "imu", self._take_gyro, qos_profile_sensor_data)
        if settings.use_pose_topic:
            self._subscribe(PoseWithCovarianceStamped, "pose", self._take_pose, qos_profile_sensor_data)
        self.create_service(Trigger, "~/reset", self._reset)
        in_sim_time = bool(self.get_parameter("use_sim_time").value)
        clock = self.get_clock() if in_sim_time else Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_PERIOD, self._tick, clock=clock)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_GRAPH_PERIOD, self._check_publishers, clock=steady)
        self.create_timer(_DIAGNOSTICS_PERIOD, self._diagnose, clock=steady)
        self._publish_state()
        self.get_logger().info(
            f"rules '{settings.rules}' ({self._rules.name}): {self.resolve_topic_name(UNCHECKED)} to "
            f"{self.resolve_topic_name(CHECKED)}"
        )

    def _subscribe(self, kind: type[Any], topic: str, take: Callable[[Message], None], qos: QoSProfile) -> None:
        """Subscribe to an input, and detect two nodes that publish on it."""
        senders, name = Senders(), self.resolve_topic_name(topic)

        def receive(message: Message, info: dict[str, Any]) -> None:
            is_shared = senders.take(info["publication_sequence_number"], time.monotonic())
            if is_shared and name not in self._shared_inputs:
                self._shared_inputs.add(name)
                self._check_publishers()
            take(message)

        self.create_subscription(kind, topic, receive, qos)

    def stop(self) -> None:
        """Send zero as the last command, and wait for a limited time until it is delivered."""
        self._send((0.0, 0.0))
        self._checked.wait_for_all_acked(Duration(seconds=_SHUTDOWN_TIME))

    @property
    def _now(self) -> float:
        return 1e-9 * self.get_clock().now().nanoseconds

    def _read_parameters(self, defaults: MonitorSettings) -> MonitorSettings:
        """Declare the settings as parameters and read them; raises ConfigError if one is invalid."""
        for name, field in MonitorSettings.model_fields.items():
            descriptor = ParameterDescriptor(description=str(field.description), read_only=True)
            self.declare_parameter(name, getattr(defaults, name), descriptor)
        for name in self._parameter_overrides:
            if self.has_parameter(name) or name.startswith(_OF_ROS):
                continue
            message = _unknown(name)
            if "did you mean" in message:
                raise ConfigError(message)
            # Only a warning, because the section `/**` of a file holds parameters of several nodes.
            self.get_logger().warning(f"without effect: {message}")
        self.add_pre_set_parameters_callback(self._reject_unknown)
        names = MonitorSettings.model_fields
        return check(MonitorSettings, {name: self.get_parameter(name).value for name in names}, "parameters")

    def _reject_unknown(self, parameters: list[Parameter]) -> list[Parameter]:
        """Raise an error that names an undeclared parameter; the error of rclpy has no name."""
        for parameter in parameters:
            if not self.has_parameter(parameter.name):
                error = ParameterNotDeclaredException([])
                error.args = (_unknown(parameter.name),)
                raise error
        return parameters

    def _take_command(self, message: Message) -> None:
        settings = self._settings
        twist = message.twist if settings.stamped else message
        stamp = seconds(message.header.stamp) if settings.stamped else 0.0
        lateral = (twist.linear.y, twist.linear.z, twist.angular.x, twist.angular.y)
        v = twist.linear.x if not any(lateral) else math.nan  # not possible for a differential drive
        out = self._judge.command(self._now, stamp, v, twist.angular.z)
        # Keep the stamp of the controller, because a base in lock step waits for the command of its tick.
        self._send(out, message.header.stamp if settings.stamped else None)
        self._publish_state()

    def _take_odometry(self, message: Message) -> None:
        settings = self._settings
        if message.child_frame_id != settings.base_frame or message.header.frame_id != settings.odom_frame:
            self._ignore("odometry", f"{message.header.frame_id} to {message.child_frame_id}")
            return
        twist = message.twist.twist
        pose = planar(message.pose.pose)
        self._judge.odometry(self._now, seconds(message.header.stamp), (twist.linear.x, twist.angular.z), pose)

    def _take_gyro(self, message: Message) -> None:
        self._judge.gyro(self._now, seconds(message.header.stamp), message.angular_velocity.z)

    def _take_pose(self, message: Message) -> None:
        if message.header.frame_id != self._settings.map_frame:
            self._ignore("a pose", message.header.frame_id)
            return
        self._judge.pose(self._now, seconds(message.header.stamp), planar(message.pose.pose))

    def _take_reference(self, message: Message) -> None:
        settings = self._settings
        frame = settings.map_frame if settings.use_pose_topic else settings.odom_frame
        points = [(seconds(point.header.stamp), *planar(point.pose)) for point in message.poses]
        if message.header.frame_id != frame:
            self._ignore("a reference", message.header.frame_id)
            points = [(math.nan, 0.0, 0.0, 0.0)]  # an invalid reference, which stops the robot
        self._judge.reference(self._now, points)
        self._publish_state()

    def _take_mode(self, message: Message) -> None:
        self._judge.says(self._now, drives=message.data.partition(":")[0] not in _STANDING_MODES)

    def _tick(self) -> None:
        out = self._judge.tick(self._now)
        if out is not None:
            self._send(out)
        self._publish_state()

    def _check_publishers(self) -> None:
        """Check for other publishers of commands, and for two publishers on an input."""
        # A killed publisher stays in the graph for a while, so a restarted node is not alone at first.
        self._shared_inputs = {name for name in self._shared_inputs if self.count_publishers(name) > 1}
        checked = self.resolve_topic_name(CHECKED)
        shared = sorted(self._shared_inputs) + [checked] * (self.count_publishers(checked) > 1)
        if shared:
            self._rivals = f"two publishers on {', '.join(shared)}"
        self._judge.outside(self._now, wrong=self._settings.exclusive and bool(shared))

    def _reset(self, _: Message, response: Message) -> Message:
        """Handle a person's request to resume."""
        self._check_publishers()
        verdict = self._judge.reset(self._now)
        response.success = not verdict
        response.message = f"still stopped: {verdict.words}" if verdict else "commands pass again"
        self._publish_state()
        return response

    def _send(self, twist: tuple[float, float], stamp: Message = None) -> None:
        stamp = self.get_clock().now().to_msg() if stamp is None else stamp
        self._checked.publish(command(twist, stamp, self._settings.base_frame, stamped=self._settings.stamped))

    @property
    def _name(self) -> str:
        """Full name of the node, with its namespace and without the first slash."""
        return str(self.get_fully_qualified_name()).lstrip("/")

    @property
    def _state_text(self) -> str:
        verdict = self._judge.verdict
        rivals = f" ({self._rivals})" if verdict.rule == "outside" else ""
        return f"{STOPPED}: {verdict.words}{rivals}; call {self._name}/reset" if verdict else PASSING

    def _publish_state(self) -> None:
        """Publish the state when it changes."""
        text = self._state_text
        if text == self._published_state:
            return
        self._published_state = text
        self._state.publish(String(data=text))
        log = self.get_logger()
        log.info(text) if text == PASSING else log.error(text)

    def _diagnose(self) -> None:
        stopped = bool(self._judge.verdict)
        level = DiagnosticStatus.ERROR if stopped else DiagnosticStatus.OK
        name = self._name
        status = DiagnosticStatus(name=f"{name}: rules", hardware_id=name, level=level, message=self._state_text)
        status.values = [KeyValue(key="rule", value=self._judge.verdict.rule)]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def _ignore(self, topic: str, frame: str) -> None:
        self.get_logger().warning(f"{topic} in frame '{frame}' is not used", throttle_duration_sec=1.0)


_MAX_WAIT = 0.1  # maximum delay of the reaction to a signal [s]


def run(arguments: Sequence[str], settings: MonitorSettings | None = None) -> None:
    """Run the monitor until SIGINT, SIGTERM or SIGHUP.

    Parameters
    ----------
    arguments
        Arguments for ROS, such as `--ros-args -r cmd_vel:=/base/cmd_vel`.
    settings
        Defaults of the parameters.

    Raises
    ------
    ValueError
        If an argument, a parameter or the rules are invalid; the message is one line.
    """
    try:
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # base class of the errors of rclpy, which are not public
        text = " ".join(str(error).split())
        raise ValueError(f"ROS cannot start with the arguments '{' '.join(arguments)}': {text}") from error
    signals: list[int] = []

    def record_signal(number: int, _: FrameType | None) -> None:
        signals.append(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, record_signal)
    executor = SingleThreadedExecutor()
    try:
        try:
            node = MonitorNode(settings)
        except ParameterException as error:
            raise ValueError(str(error)) from error
        executor.add_node(node)
        try:
            while not signals:
                executor.spin_once(timeout_sec=_MAX_WAIT)
        except ExternalShutdownException:
            pass
        finally:
            node.stop()
            node.destroy_node()
    finally:
        executor.shutdown()
        rclpy.try_shutdown()
