"""The estimate as nav_msgs/Odometry, for nodes that want a smoother or truer pose than the wheels give."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.lifecycle import LifecycleNode

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.estimation.estimate import Estimate
from diffdrive_mpc.mpc.ros.conversions import pose_message, time_message, twist_message
from diffdrive_mpc.mpc.ros.settings import NodeSettings

ESTIMATE = "~/estimate"
# Rows of x, y, yaw and of forward speed, yaw rate in ROS' 6 x 6 covariances.
_POSE, _TWIST = (0, 1, 5), (0, 5)


class EstimateOutput:
    """Publishes the estimate, slip included, where anybody listens.

    Parameters
    ----------
    node
        The node.
    settings
        Its settings.
    frame
        Frame that control is in.
    """

    def __init__(self, node: LifecycleNode, settings: NodeSettings, frame: str) -> None:
        self._node, self._base, self._frame = node, settings.base_frame, frame
        self._publisher = node.create_lifecycle_publisher(Odometry, ESTIMATE, 10)

    def send(self, estimate: Estimate | None, time: int) -> None:
        """Send the estimate of the tick at `time` [ns]; nothing before the first pose."""
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
    """(36,) row by row: variances of what is estimated, zero for what is not; correlations are left out."""
    diagonal = np.zeros(6)
    diagonal[list(rows)] = np.square(deviation)
    return [float(value) for value in np.diag(diagonal).ravel()]
