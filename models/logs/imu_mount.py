"""Yaw rate of a gyro about the axis that /tf_static of a bag states as vertical: the node reads it about this axis."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.bag_reader import Bag
from diffdrive_mpc.models.logs.bag_topics import IMU, Decoders, Reading

_TOPIC, _TYPE = "/tf_static", "tf2_msgs/msg/TFMessage"
# A quaternion's norm differs from 1 by no more, and an axis with a smaller share of the vertical has no part [-].
_NORM_TOLERANCE, _ALIGNED = 1e-2, 1e-3


def imu_decoders(reader: Bag) -> Decoders:
    """Return decoders of the yaw rate [rad/s]; about z of the gyro's frame unless static transforms turn that frame."""
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    known = next((known for known in reader.connections if known[:2] == (_TOPIC, _TYPE)), None)
    if known is None:
        return IMU
    store = get_typestore(Stores.ROS2_JAZZY)
    placed: dict[str, tuple[str, FloatArray]] = {}
    for _, _, data in reader.messages([known]):
        message: Any = store.deserialize_cdr(data, _TYPE)
        for each in message.transforms:
            q = each.transform.rotation
            turn = np.array([q.x, q.y, q.z, q.w])
            if abs(np.linalg.norm(turn) - 1.0) <= _NORM_TOLERANCE:
                parent, child = (name.removeprefix("/") for name in (each.header.frame_id, each.child_frame_id))
                placed[child] = parent, turn / np.linalg.norm(turn)

    @cache
    def vertical(frame: str) -> FloatArray:
        # The root of the static frames is the robot's body. Loops of frames end at their start.
        if frame not in placed:
            return np.array([0.0, 0.0, 1.0])
        parent, turn = placed.pop(frame)
        axis, u = vertical(parent), turn[:3]
        across = 2.0 * np.cross(u, axis)
        return np.asarray(axis - turn[3] * across + np.cross(u, across))

    def yaw_rate(message: Any) -> Reading:  # noqa: ANN401 - rosbags makes the types
        axis, rate = vertical(message.header.frame_id.removeprefix("/")), message.angular_velocity
        used = np.abs(axis) > _ALIGNED
        return (float(axis[used] @ np.array([rate.x, rate.y, rate.z])[used]),)

    return dict.fromkeys(IMU, yaw_rate)
