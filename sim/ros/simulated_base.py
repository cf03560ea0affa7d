"""Simulated mobile base, which is a plant with ROS topics."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry as OdometryMessage
from numpy.typing import ArrayLike
from pydantic import Field
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String

from diffdrive_mpc.models.checked_yaml import StrictModel, check, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.drive_log.topics import DRIVE, TICK
from diffdrive_mpc.models.plug_ins import plug_in
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.ros import messages
from diffdrive_mpc.sim.ros.messages import MessageRecorder
from diffdrive_mpc.sim.sensing.odometry import Odometry

SETTINGS_FILE = Path(__file__).parent / "base.yaml"

Ticks = Annotated[int, Field(ge=1, le=1000)]
Seconds = Annotated[float, Field(gt=0, le=60)]


class TopicIntervals(StrictModel):
    """Number of control samples between messages of a topic."""

    odometry: Ticks = Field(description="interval of odom [samples]")
    imu: Ticks = Field(description="interval of imu [samples]")
    joint_states: Ticks = Field(description="interval of joint_states [samples]")
    ground_truth: Ticks = Field(description="interval of ground_truth/pose and ground_truth/twist [samples]")


class LockStep(StrictModel):
    """Settings of the lock step of clock and commands."""

    # Poses may be 2 s late, and stamps of poses before the start must not be negative.
    first_tick: int = Field(ge=200, le=1_000_000, description="number of control samples on /clock at the start")
    settling_time: Seconds = Field(description="real time without a new connection before the first tick [s]")
    answer_timeout: Seconds = Field(description="maximum real time to wait for the command of a tick [s]")
    clock_repeat: Seconds = Field(description="real time after which an unanswered /clock is sent again [s]")


class RealTime(StrictModel):
    """Settings of real-time operation."""

    most_behind: Seconds = Field(description="maximum delay relative to real time; a larger delay is skipped [s]")


class BaseSettings(StrictModel):
    """Settings of the simulated base."""

    stamped: bool = Field(description="true: commands are TwistStamped; false: Twist")
    frame_prefix: str = Field("", description="prefix of all frames except map, such as r1/")
    transforms: Literal["none", "odom", "map"] = Field(
        "none", description="odom: odom -> base_link on /tf; map: also map -> odom, like an error-free localisation"
    )
    command_timeout: Seconds = Field(description="time without a command after which the base stops, robot clock [s]")
    odometry_pose: Literal["dead_reckoning", "pose_sensor"] = Field(description="source of the pose in odom")
    every: TopicIntervals
    lock_step: LockStep
    real_time: RealTime


def load_base_settings(path: str | Path | None = None, changes: Mapping[str, object] | None = None) -> BaseSettings:
    """Read base settings; by default those of the package.

    Parameters
    ----------
    path
        YAML file with all settings.
    changes
        Values that replace those of the file, by dotted key such as "lock_step.answer_timeout"; None keeps the value.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file cannot be read, or a value is missing, unknown or out of range.
    """
    settings = load_checked(BaseSettings, path or SETTINGS_FILE)
    values = settings.model_dump()
    for key, value in (changes or {}).items():
        if value is not None:
            *groups, name = key.split(".")
            reduce(dict.__getitem__, groups, values)[name] = value
    return check(BaseSettings, values, "base settings")


STOP = (0.0, 0.0)


class CommandInbox:
    """Newest valid command with a timeout.

    Times are integer nanoseconds on the robot's clock.

    Parameters
    ----------
    timeout
        Time for which a command is valid, and maximum age of its stamp [ns].
    tolerance
        Maximum difference between the stamp of a command and the time of its tick [ns].
    """

    def __init__(self, timeout: int, tolerance: int) -> None:
        self._timeout, self._tolerance = timeout, tolerance
        self._command = STOP
        self._received: int | None = None
        self._stamp = 0

    def put(self, v: float, omega: float, stamp: int, now: int) -> str:
        """Store a valid command v [m/s], omega [rad/s] that arrives at `now`.

        Parameters
        ----------
        stamp
            Stamp of the header; 0 if the stamp is missing or not set.

        Returns
        -------
        str
            Reason for a refusal; empty if the command is accepted.
        """
        if not (math.isfinite(v) and math.isfinite(omega)):
            return f"command v = {v}, omega = {omega} is not finite and is ignored"
        if stamp and abs(now - stamp) > self._timeout:
            age = f"{1e-9 * abs(now - stamp):.3f} s {'old' if stamp < now else 'ahead'}"
            return f"the stamp of the command is {age}; the command is ignored: use the robot's clock (use_sim_time)"
        self._command, self._stamp, self._received = (v, omega), stamp, now
        return ""

    def command(self, now: int) -> tuple[float, float]:
        """Return the effective command v [m/s], omega [rad/s] at `now`; zero after the timeout."""
        return STOP if self.timed_out(now) or self._received is None else self._command

    def timed_out(self, now: int) -> bool:
        """Return True if the last command has timed out."""
        return self._received is not None and now - self._received > self._timeout

    def has_command_for(self, tick: int) -> bool:
        """Return True if stamp or arrival time of the newest command belong to the tick at the time `tick` [ns]."""
        if self._received is None:
            return False
        return abs((self._stamp or self._received) - tick) <= self._tolerance


# Topics with reports of the controller's node, which allow an exact replay of real-time recordings.
_CONTROLLER_TOPICS = (TICK, DRIVE)
# Minimum time between equal warnings [s].
_WARNING_PERIOD = 1.0
# Period of the check for publishers of the unsupported command type [s].
_CHECK_PERIOD = 0.5


class BaseTopics(Protocol):
    """Interface of additional topics of the base.

    Packages register factories in the group `diffdrive_mpc.plants` under the name `transforms`, and under the names in
    the attribute `base_topics` of a plant. A factory is a function of node, plant and settings.
    """

    def send(self, now: int, origin: int, odometry: FloatArray | None, plant: Plant) -> Iterable[tuple[str, Any]]:
        """Publish the messages that are due at a tick, and return them with their topics.

        Parameters
        ----------
        now, origin
            Times of the tick and of the plant's time 0 on the robot's clock [ns].
        odometry
            (3,) pose in odom; None at ticks without odometry.
        plant
            Simulated robot.
        """
        ...


def _additional_topics(node: Node, plant: Plant, settings: BaseSettings) -> list[BaseTopics]:
    """Create the topics that settings and plant require; raise MissingPackageError if a package is not installed."""
    names = [] if settings.transforms == "none" else ["transforms"]
    names += getattr(plant, "base_topics", ())
    return [plug_in("plants", name)(node, plant, settings) for name in names]


class SimulatedBase:
    """Base that publishes the sensor data of a plant and drives the plant with received commands.

    Sensor data are published with best-effort QoS; commands are received with reliable QoS and depth 1. `sim.ros.pace`
    controls the timing of samples.

    Parameters
    ----------
    node
        Node of the topics.
    plant
        Simulated robot, which is reset.
    start
        (3,) start pose x [m], y [m], theta [rad].
    settings
        Rates, timeouts and command type.
    pose_memory
        Maximum latency of the pose sensor in ticks.
    clock
        Function that returns the robot's time [ns].
    record
        Recorder of all sent and received messages; None to disable the recording.
    correction
        Ratios of the readings of wheels and gyro to speed and yaw rate, which the odometry pose corrects [-].
    """

    def __init__(
        self,
        node: Node,
        plant: Plant,
        start: ArrayLike,
        settings: BaseSettings,
        *,
        pose_memory: int,
        clock: Callable[[], int],
        record: MessageRecorder | None = None,
        correction: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        self.node, self.plant = node, plant
        self._settings, self._clock, self._record = settings, clock, record
        plant.reset(start)
        uses_pose_sensor = settings.odometry_pose == "pose_sensor"
        self._odometry = Odometry(plant.true_pose, pose_memory, use_pose_sensor=uses_pose_sensor, correction=correction)
        self._wheel_angles, self._wheel_speeds = np.zeros(4), np.zeros(4)
        self.tick = 0
        tolerance = round(0.5e9 * plant.sample_time)
        self.inbox = CommandInbox(round(1e9 * settings.command_timeout), tolerance)
        self._had_timed_out = False
        kinds = {
            "odom": OdometryMessage,
            "imu": Imu,
            "pose": PoseWithCovarianceStamped,
            "joint_states": JointState,
            "ground_truth/pose": PoseStamped,
            "ground_truth/twist": TwistStamped,
        }
        self._topics = _additional_topics(node, plant, settings)
        self._publishers = {
            topic: node.create_publisher(kind, topic, qos_profile_sensor_data) for topic, kind in kinds.items()
        }
        kind = TwistStamped if settings.stamped else Twist
        self._rejected_senders = ""
        self._check = node.create_timer(
            _CHECK_PERIOD, self._check_senders, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self._commands = node.create_subscription(kind, "cmd_vel", self._receive, QoSProfile(depth=1))
        if record is not None:
            self._records = [self._subscribe_recorder(node, topic, record) for topic in _CONTROLLER_TOPICS]

    @property
    def has_command_publisher(self) -> bool:
        """True if commands have a publisher."""
        return self._commands.get_publisher_count() > 0

    @property
    def has_odometry_subscriber(self) -> bool:
        """True if odometry has a subscriber."""
        return bool(self._publishers["odom"].get_subscription_count() > 0)

    @property
    def connections(self) -> tuple[int, ...]:
        """Number of connections of each topic."""
        readers = (publisher.get_subscription_count() for publisher in self._publishers.values())
        return (self._commands.get_publisher_count(), *readers)

    @property
    def command_topic(self) -> str:
        """Full name of the command topic."""
        return str(self._commands.topic_name)

    def _check_senders(self) -> None:
        """Warn once about publishers of the unsupported command type."""
        supported, unsupported = ("TwistStamped", "Twist") if self._settings.stamped else ("Twist", "TwistStamped")
        infos = self.node.get_publishers_info_by_topic(self.command_topic)
        names = {info.node_name for info in infos if info.topic_type == f"geometry_msgs/msg/{unsupported}"}
        # Discovery may report a publisher before the name of its node.
        senders = " and ".join(sorted(name for name in names if "_UNKNOWN_" not in name))
        if senders and senders != self._rejected_senders:
            option, parameter = ("--unstamped", "true") if self._settings.stamped else ("--stamped", "false")
            self.node.get_logger().warning(
                f"{senders} publishes {unsupported} on {self.command_topic}, but this robot subscribes to {supported}: "
                f"start the robot with {option}, or set the node's parameter stamped:={parameter}"
            )
        self._rejected_senders = senders

    def _subscribe_recorder(self, node: Node, topic: str, record: MessageRecorder) -> Subscription:
        """Subscribe to `topic` of a controller for the recording; the robot does not use the messages."""
        # The controller is in the namespace of the robot.
        name = node.resolve_topic_name(topic.lstrip("/"))
        return node.create_subscription(
            String, name, lambda message: record(name, message, self._clock()), QoSProfile(depth=100)
        )

    def publish_sensors(self, now: int, origin: int) -> None:
        """Publish the sensor data of the current tick.

        Parameters
        ----------
        now
            Time of the tick on the robot's clock [ns].
        origin
            Time of the plant's time 0 on the robot's clock [ns].
        """
        due = {topic: self.tick % every == 0 for topic, every in self._settings.every.model_dump().items()}
        measurement = self.plant.measure()
        pose = self._odometry.update(self.plant.time, measurement)
        if measurement.wheel_speeds is not None:
            speeds = np.asarray(measurement.wheel_speeds.value, dtype=float)
            self._wheel_angles += 0.5 * self.plant.sample_time * (self._wheel_speeds + speeds)
            self._wheel_speeds = speeds
            if due["joint_states"]:
                self._publish("joint_states", messages.joint_state(now, self._wheel_angles, speeds))
        if due["ground_truth"]:
            self._publish("ground_truth/pose", messages.true_pose(now, self.plant.true_pose))
            self._publish("ground_truth/twist", messages.true_twist(now, self.plant.true_twist))
        if measurement.pose is not None:
            stamp = origin + round(1e9 * measurement.pose.time)
            self._publish("pose", messages.measured_pose(stamp, measurement.pose))
        if measurement.yaw_rate is not None and due["imu"]:
            self._publish("imu", messages.imu(now, measurement.yaw_rate))
        has_odometry = measurement.wheel_twist is not None and due["odometry"]
        if measurement.wheel_twist is not None and has_odometry:
            self._publish("odom", messages.odometry(now, pose, measurement.wheel_twist))
        for topics in self._topics:
            for topic, message in topics.send(now, origin, pose if has_odometry else None, self.plant):
                if self._record is not None:
                    self._record(topic, message, self._clock())

    def advance(self, now: int) -> None:
        """Advance by one sample with the effective command at `now` [ns].

        Raises
        ------
        sim.plants.plant.RobotLostError
            If the robot tips over or its motion diverges.
        """
        timed_out = self.inbox.timed_out(now)
        if timed_out and not self._had_timed_out:
            self.node.get_logger().warning(
                f"no command on {self.command_topic} for {self._settings.command_timeout} s: the robot stops"
            )
        self._had_timed_out = timed_out
        self.plant.advance(self.inbox.command(now))
        self.tick += 1

    def _receive(self, message: Any) -> None:  # noqa: ANN401 - ROS messages have no types to check
        now = self._clock()
        if self._record is not None:
            self._record(self.command_topic, message, now)
        stamp = messages.nanoseconds(message.header.stamp) if self._settings.stamped else 0
        twist = message.twist if self._settings.stamped else message
        refusal = self.inbox.put(twist.linear.x, twist.angular.z, stamp, now)
        if refusal:
            self.node.get_logger().warning(refusal, throttle_duration_sec=_WARNING_PERIOD)

    def _publish(self, topic: str, message: Any) -> None:  # noqa: ANN401
        publisher = self._publishers[topic]
        if self._settings.frame_prefix:
            messages.set_prefix(message, self._settings.frame_prefix)
        publisher.publish(message)
        if self._record is not None:
            self._record(publisher.topic_name, message, self._clock())
