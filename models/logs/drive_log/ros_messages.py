"""ROS 2 messages from numbers and their CDR serialisation by `rosbags`, without ROS. Units and axes follow REP 103."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Stamped
from diffdrive_mpc.models.logs.drive_log.topics import BASE, IMU_LINK, MAP, ODOM, WHEELS

_NANO = 10**9
# Rows of (x, y, yaw) and of (x, yaw) in the 6 x 6 covariances of ROS over x, y, z, roll, pitch, yaw.
_PLANE, _FORWARD = (0, 1, 5), (0, 5)
# POWER_SUPPLY_STATUS_... of BatteryState.
_CHARGING, _DISCHARGING = 1, 2
Numbers = Sequence[float]
Message = Any
"""A message of a class that `rosbags` generates."""


@cache
def _store() -> Any:  # noqa: ANN401 - its classes are generated at run time
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - needed for writing only

    return get_typestore(Stores.ROS2_JAZZY)


def definition(kind: str) -> bytes:
    """Return the definition of a message type, including nested types."""
    return str(_store().generate_msgdef(kind, ros_version=2)[0]).encode()


def serialize(kind: str, message: Message) -> bytes:
    """Serialise a message as CDR."""
    return bytes(_store().serialize_cdr(message, kind))


def decode(kind: str, data: bytes) -> Message:
    """Deserialise a message from CDR."""
    return _store().deserialize_cdr(data, kind)


def command(now: int, twist: Numbers) -> Message:
    """Build TwistStamped in the robot's frame at `now` [ns]: v [m/s], omega [rad/s]."""
    return _make("geometry_msgs/msg/TwistStamped", header=_header(now, BASE), twist=_twist(twist[0], 0.0, twist[1]))


def true_twist(now: int, twist: Numbers) -> Message:
    """Build TwistStamped in the robot's frame: forward, lateral speed [m/s], yaw rate [rad/s]."""
    return _make("geometry_msgs/msg/TwistStamped", header=_header(now, BASE), twist=_twist(*twist))


def odometry(stamp: int, pose: ArrayLike | None, twist: Stamped) -> Message:
    """Build Odometry: twist of the wheels (2,), pose (3,) in odom.

    As usual in ROS, a covariance of zeros means unknown. The covariance of the integrated pose is always unknown.
    """
    v, omega = _list(twist.value)
    twist_with_covariance = _make(
        "geometry_msgs/msg/TwistWithCovariance",
        twist=_twist(v, 0.0, omega),
        covariance=_covariance(twist.covariance, _FORWARD),
    )
    return _make(
        "nav_msgs/msg/Odometry",
        header=_header(stamp, ODOM),
        child_frame_id=BASE,
        pose=_with_covariance((0.0, 0.0, 0.0) if pose is None else pose, None),
        twist=twist_with_covariance,
    )


def imu(stamp: int, yaw_rate: Stamped) -> Message:
    """Build Imu with a yaw rate (); orientation and acceleration are marked as not measured."""
    not_measured, rate_covariance = np.zeros(9), np.zeros(9)
    # sensor_msgs/Imu: -1 in the first element marks a quantity that is not measured.
    not_measured[0] = -1.0
    if yaw_rate.covariance is not None:
        rate_covariance[8] = np.ravel(yaw_rate.covariance)[0]
    return _make(
        "sensor_msgs/msg/Imu",
        header=_header(stamp, IMU_LINK),
        orientation=_rotation(0.0),
        orientation_covariance=not_measured,
        angular_velocity=_vector(0.0, 0.0, float(np.asarray(yaw_rate.value))),
        angular_velocity_covariance=rate_covariance,
        linear_acceleration=_vector(0.0, 0.0, 0.0),
        linear_acceleration_covariance=not_measured,
    )


def sensed_pose(stamp: int, pose: Stamped) -> Message:
    """Build PoseWithCovarianceStamped in the frame map from a pose (3,)."""
    return _make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=_header(stamp, MAP),
        pose=_with_covariance(pose.value, pose.covariance),
    )


def joint_state(stamp: int, speeds: Stamped) -> Message:
    """Build JointState with the speeds (4,) of the wheels [rad/s]."""
    # sensor_msgs/JointState: empty arrays mark quantities without values.
    empty = np.empty(0)
    return _make(
        "sensor_msgs/msg/JointState",
        header=_header(stamp, ""),
        name=list(WHEELS),
        position=empty,
        velocity=np.array(speeds.value, dtype=float),
        effort=empty,
    )


def battery_state(now: int, voltage: float, current: float) -> Message:
    """Build BatteryState: voltage [V], output current [A], which the message negates; all other fields are unknown."""
    unknown = math.nan
    return _make(
        "sensor_msgs/msg/BatteryState",
        header=_header(now, BASE),
        voltage=voltage,
        temperature=unknown,
        current=-current,
        charge=unknown,
        capacity=unknown,
        design_capacity=unknown,
        percentage=unknown,
        power_supply_status=_DISCHARGING if current > 0 else _CHARGING,
        power_supply_health=0,
        power_supply_technology=0,
        present=True,
        cell_voltage=np.empty(0, dtype=np.float32),
        cell_temperature=np.empty(0, dtype=np.float32),
        location="",
        serial_number="",
    )


def motor_currents(currents: Numbers) -> Message:
    """Build Float64MultiArray: front left, front right, rear left, rear right [A]."""
    layout = _make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    return _make("std_msgs/msg/Float64MultiArray", layout=layout, data=np.array(currents, dtype=float))


def pose(now: int, place: Numbers, frame: str) -> Message:
    """Build PoseStamped: x [m], y [m], theta [rad]."""
    return _make("geometry_msgs/msg/PoseStamped", header=_header(now, frame), pose=_pose(place))


def path(now: int, stamps: Sequence[int], poses: Sequence[Numbers], frame: str) -> Message:
    """Build Path from poses (n, 3) with stamps (n,) [ns]."""
    places = [pose(stamp, place, frame) for stamp, place in zip(stamps, poses, strict=True)]
    return _make("nav_msgs/msg/Path", header=_header(now, frame), poses=places)


def vector(now: int, values: Numbers) -> Message:
    """Build Vector3Stamped in the robot's frame."""
    return _make("geometry_msgs/msg/Vector3Stamped", header=_header(now, BASE), vector=_vector(*values))


def text(content: str) -> Message:
    """Build String."""
    return _make("std_msgs/msg/String", data=content)


def transform(now: int, place: Numbers, frame: str) -> Message:
    """Build TFMessage with the robot's pose (3,) in `frame`."""
    transform_content = _make(
        "geometry_msgs/msg/Transform", translation=_vector(place[0], place[1], 0.0), rotation=_rotation(place[2])
    )
    kind = "geometry_msgs/msg/TransformStamped"
    return _make(
        "tf2_msgs/msg/TFMessage",
        transforms=[_make(kind, header=_header(now, frame), child_frame_id=BASE, transform=transform_content)],
    )


def diagnostics(now: int, level: int, content: str, values: Mapping[str, str]) -> Message:
    """Build DiagnosticArray with one status under the name that the node uses; levels: 0 good, 1 warning, 2 error."""
    pairs = [_make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()]
    status = _make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name="diffdrive_mpc: control",
        message=content,
        hardware_id="diffdrive_mpc",
        values=pairs,
    )
    return _make("diagnostic_msgs/msg/DiagnosticArray", header=_header(now, ""), status=[status])


def planar(message: Message) -> tuple[float, float, float]:
    """Extract x [m], y [m], theta [rad] of a planar Pose."""
    return message.position.x, message.position.y, 2.0 * math.atan2(message.orientation.z, message.orientation.w)


def _make(kind: str, **values: object) -> Message:
    return _store().types[kind](**values)


def _header(now: int, frame: str) -> Message:
    stamp = _make("builtin_interfaces/msg/Time", sec=now // _NANO, nanosec=now % _NANO)
    return _make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _vector(x: float, y: float, z: float) -> Message:
    return _make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _twist(forward: float, lateral: float, yaw_rate: float) -> Message:
    return _make("geometry_msgs/msg/Twist", linear=_vector(forward, lateral, 0.0), angular=_vector(0.0, 0.0, yaw_rate))


def _rotation(theta: float) -> Message:
    return _make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(theta / 2), w=math.cos(theta / 2))


def _pose(coordinates: Numbers) -> Message:
    place = _make("geometry_msgs/msg/Point", x=coordinates[0], y=coordinates[1], z=0.0)
    return _make("geometry_msgs/msg/Pose", position=place, orientation=_rotation(coordinates[2]))


def _with_covariance(coordinates: ArrayLike, covariance: ArrayLike | None) -> Message:
    kind = "geometry_msgs/msg/PoseWithCovariance"
    return _make(kind, pose=_pose(_list(coordinates)), covariance=_covariance(covariance, _PLANE))


def _list(values: ArrayLike) -> list[float]:
    numbers: list[float] = np.asarray(values, dtype=float).tolist()
    return numbers


def _covariance(entries: ArrayLike | None, rows: tuple[int, ...]) -> FloatArray:
    """Build a covariance (36,), row-major, with zeros for unknown entries."""
    matrix = np.zeros((6, 6))
    if entries is not None:
        matrix[np.ix_(rows, rows)] = entries
    return matrix.ravel()
