"""Decoders of a gyro's yaw rate about the vertical axis, which is known from /tf_static as in the node."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.bag_reader import Bag
from diffdrive_mpc.models.logs.bag_topics import IMU, Decoders, Reading

_TOPIC, _TYPE = "/tf_static", "tf2_msgs/msg/TFMessage"
# Maximum deviation of a quaternion's norm from 1, and minimum vertical component of a used axis [-].
_NORM_TOLERANCE, _MIN_COMPONENT = 1e-2, 1e-3


def imu_decoders(reader: Bag) -> Decoders:
    """Return decoders of the yaw rate [rad/s] about the vertical axis, or about z of the gyro without transforms."""
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    known = next((known for known in reader.connections if known[:2] == (_TOPIC, _TYPE)), None)
    if known is None:
        return IMU
    store = get_typestore(Stores.ROS2_JAZZY)
    parents: dict[str, tuple[str, FloatArray]] = {}
    for _, _, data in reader.messages([known]):
        message: Any = store.deserialize_cdr(data, _TYPE)
        for entry in message.transforms:
            q = entry.transform.rotation
            rotation = np.array([q.x, q.y, q.z, q.w])
            if abs(np.linalg.norm(rotation) - 1.0) <= _NORM_TOLERANCE:
                parent, child = (name.removeprefix("/") for name in (entry.header.frame_id, entry.child_frame_id))
                parents[child] = parent, rotation / np.linalg.norm(rotation)

    @cache
    def vertical(frame: str) -> FloatArray:
        # The root of the static frames is the body. Each frame is removed when visited, so a loop of frames ends.
        if frame not in parents:
            return np.array([0.0, 0.0, 1.0])
        parent, rotation = parents.pop(frame)
        axis, u = vertical(parent), rotation[:3]
        # Rotate the vertical from the parent to the child by the inverse of the unit quaternion.
        cross = 2.0 * np.cross(u, axis)
        return np.asarray(axis - rotation[3] * cross + np.cross(u, cross))

    def yaw_rate(message: Any) -> Reading:  # noqa: ANN401 - rosbags creates the types
        axis, rate = vertical(message.header.frame_id.removeprefix("/")), message.angular_velocity
        # An unused axis may be NaN in the message and must not affect the sum.
        is_used = np.abs(axis) > _MIN_COMPONENT
        return (float(axis[is_used] @ np.array([rate.x, rate.y, rate.z])[is_used]),)

    return dict.fromkeys(IMU, yaw_rate)
