"""Input buffer that collects sensor messages between two ticks."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu

from diffdrive_mpc.models.interface import Measurement, Stamped
from diffdrive_mpc.mpc.ros.conversions import (
    NANOSECONDS,
    MessageError,
    check_frame,
    imu_yaw_rate,
    measured_pose,
    odometry_pose,
    odometry_twist,
    seconds,
)
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.ros.topic_watch import TopicWatch
from diffdrive_mpc.mpc.ros.transforms.buffer import TransformBuffer, TransformError
from diffdrive_mpc.mpc.ros.transforms.frames import Frames


class Inbox:
    """Buffer that checks messages and stores the newest valid message of each kind for the next tick.

    Parameters
    ----------
    settings
        Settings of the node: frames and used sensors.
    clock
        The node's clock [ns].
    epoch
        Time of the node's clock at the controller's time 0 [ns].
    frames
        Transforms; None if they are not used.

    Attributes
    ----------
    mounts
        Transforms of the gyro's mount; None if the z axis of the gyro points up.
    """

    def __init__(
        self, settings: NodeSettings, clock: Callable[[], int], epoch: int, frames: Frames | None = None
    ) -> None:
        self._settings, self._clock, self._epoch, self.frames = settings, clock, epoch, frames
        self.mounts: TransformBuffer | None = None
        self.odometry, self.imu = TopicWatch("odometry"), TopicWatch("imu")
        by_tf = settings.poses_from == "tf"
        self.pose = TopicWatch(f"transform {settings.map_frame} -> {settings.base_frame}" if by_tf else "pose")
        self.restart()

    def restart(self) -> None:
        """Discard all received messages."""
        self.newest_pose: Stamped | None = None
        self._pose: Stamped | None = None
        self._twist: Stamped | None = None
        self._yaw_rate: Stamped | None = None
        self._last_stamp = 0
        for watch in (self.odometry, self.imu, self.pose):
            watch.restart()
        if self.frames is not None:
            self.frames.buffer.clear()

    @property
    def now(self) -> float:
        """Time on the controller's clock [s]."""
        return seconds(self._clock(), self._epoch)

    def time_of(self, stamp: int) -> float:
        """Convert a stamp [ns] to a time on the controller's clock [s]."""
        return seconds(stamp, self._epoch)

    def stamp_of(self, time: float) -> int:
        """Convert a time on the controller's clock [s] to a stamp [ns]."""
        return self._epoch + round(NANOSECONDS * time)

    @property
    def has_pose(self) -> bool:
        """True if the next measurement has a pose."""
        return self._pose is not None

    @property
    def topics(self) -> list[TopicWatch]:
        """Watches of the used topics."""
        settings = self._settings
        topics = (
            (self.odometry, True),
            (self.imu, settings.use_imu),
            (self.pose, settings.poses_from != "odometry"),
        )
        return [topic for topic, is_used in topics if is_used]

    @property
    def fault(self) -> str:
        """Fault of an optional topic, which does not stop the robot; empty if there is no fault."""
        settings = self._settings
        return self.imu.fault(self.now, settings.odom_timeout) if settings.use_imu else ""

    @property
    def frame(self) -> str:
        """Control frame."""
        return self._settings.control_frame

    def receive_odometry(self, message: Odometry) -> None:
        """Store the twist of wheel odometry, and its pose if poses come from odometry."""
        settings = self._settings
        try:
            check_frame(message.child_frame_id, settings.base_frame, "base_frame", "child_frame_id")
            twist = odometry_twist(message, self._epoch)
            pose = None
            if settings.poses_from == "odometry":
                check_frame(message.header.frame_id, settings.odom_frame, "odom_frame")
                pose = odometry_pose(message, self._epoch)
            self.odometry.accept(twist.time, self.now, self._settings.odom_timeout)
        except MessageError as error:
            self.odometry.refuse(str(error))
            return
        # A message is stored only if both twist and pose are valid.
        self._twist = twist
        if pose is not None:
            self.newest_pose = self._pose = pose

    def receive_imu(self, message: Imu) -> None:
        """Store the yaw rate of the gyro."""
        try:
            yaw_rate = imu_yaw_rate(message, self._epoch, self._upward(message.header.frame_id))
            self.imu.accept(yaw_rate.time, self.now, self._settings.odom_timeout)
        except MessageError as error:
            self.imu.refuse(str(error))
            return
        self._yaw_rate = yaw_rate

    def _upward(self, frame: str) -> tuple[float, float, float]:
        """Return the upward direction in the gyro's frame; the z axis if there is no transform."""
        if self.mounts is not None:
            with suppress(TransformError):
                return self.mounts.lookup(self._settings.base_frame, frame, self._clock()).transform.vertical
        return 0.0, 0.0, 1.0

    def receive_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Store a pose, for example from SLAM."""
        try:
            check_frame(message.header.frame_id, self._settings.map_frame, "map_frame")
            pose = measured_pose(message, self._epoch, covariance=self._settings.pose_covariance)
            self.pose.accept(pose.time, self.now, self._settings.odom_timeout)
        except MessageError as error:
            self.pose.refuse(str(error))
            return
        self.newest_pose = self._pose = pose

    def look_up_pose(self) -> None:
        """Store the newest pose from transforms if it is newer than at the last call."""
        if self.frames is None or self._settings.poses_from != "tf":
            return
        try:
            value, stamp = self.frames.pose()
            if stamp <= self._last_stamp:
                # The transform is known but was already used.
                self.pose.reason = ""
                return
            time = seconds(stamp, self._epoch)
            self.pose.accept(time, self.now, self._settings.odom_timeout)
        except (TransformError, MessageError) as error:
            # A persistent fault counts once, not at every tick.
            if self.pose.reason.endswith(str(error)):
                return
            self.pose.refuse(str(error))
            return
        self._last_stamp = stamp
        self.newest_pose = self._pose = Stamped(value, time)

    def measurement(self) -> Measurement:
        """Collect the measurements since the last call."""
        measurement = Measurement(pose=self._pose, wheel_twist=self._twist, yaw_rate=self._yaw_rate)
        self._pose = self._twist = self._yaw_rate = None
        return measurement
