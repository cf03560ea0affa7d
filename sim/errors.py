"""Tracking errors over time, all of the true pose against the reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from models.interface import FloatArray
from models.pose import wrap_angle
from sim.metric_settings import metric_settings
from sim.path_projection import path_polyline

if TYPE_CHECKING:
    from sim.run import Run


@dataclass(frozen=True, slots=True)
class TrackingErrors:
    """Error series over the n ticks of a run.

    Attributes
    ----------
    position
        (n,) distance to the reference at the same time [m].
    heading
        (n,) true minus reference heading, wrapped [rad].
    course
        (n,) direction of travel, side-slip included, against the path's tangent, wrapped [rad]; NaN where the robot
        or the reference stands.
    lateral
        (n,) signed distance from the path, positive to its left [m].
    """

    position: FloatArray
    heading: FloatArray
    course: FloatArray
    lateral: FloatArray


def tracking_errors(run: Run) -> TrackingErrors:
    """Error series of `run`, whose definitions are those of `TrackingErrors`."""
    settings = metric_settings()
    polyline = path_polyline(run.reference, settings.path_spacing, settings.path_window)
    offset = run.true_pose[:, :2] - run.reference_pose[:, :2]
    return TrackingErrors(
        position=np.hypot(offset[:, 0], offset[:, 1]),
        heading=wrap_angle(run.true_pose[:, 2] - run.reference_pose[:, 2]),
        course=_course_error(run, settings.moving_speed),
        lateral=polyline.lateral(run.true_pose[:, :2], run.reference_arc_length, settings.path_window),
    )


def _course_error(run: Run, moving_speed: float) -> FloatArray:
    forward, sideways = run.true_twist[:, 0], run.true_twist[:, 1]
    reference_speed = run.reference_twist[:, 0]
    moving = (np.hypot(forward, sideways) > moving_speed) & (np.abs(reference_speed) > moving_speed)
    course = run.true_pose[:, 2] + np.arctan2(sideways, forward)
    tangent = run.reference_pose[:, 2] + np.where(reference_speed < 0, np.pi, 0.0)
    return np.where(moving, wrap_angle(course - tangent), np.nan)
