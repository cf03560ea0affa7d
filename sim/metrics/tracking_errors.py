"""Tracking errors over time, all of the true pose against the reference, and the thresholds of the metrics."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray, ReadOnlyArrays, Reference, ReferenceSample
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.sim.metrics.path_projection import path_polyline


class MetricSettings(StrictModel):
    """Thresholds that turn error series into statistics."""

    band: Positive = Field(description="lateral band [m]")
    moving_speed: Positive = Field(description="least speed at which a course error is taken [m/s]")
    end_error: Positive = Field(description="largest distance from the end of a completed run [m]")
    path_window: Positive = Field(description="arc length searched on both sides of the reference [m]")
    path_spacing: Positive = Field(description="spacing of the path's polyline [m]")
    settled_arc: Positive = Field(description="time of constant twist after which an arc counts as steady [s]")


@cache
def metric_settings() -> MetricSettings:
    """Read the shipped thresholds; raises ConfigError when the file has a mistake."""
    return load_checked(MetricSettings, Path(__file__).parent / "metrics.yaml")


@dataclass(frozen=True, repr=False)
class TrackingErrors(ReadOnlyArrays):
    """Error series over the n ticks of a run.

    Attributes
    ----------
    position
        (n,) distance to the reference at the same time [m].
    heading
        (n,) true minus reference heading at the same time, wrapped [rad].
    course
        (n,) direction of travel, side-slip included, minus the path's tangent where the reference is at the same time
        (not where the robot is nearest to the path), wrapped [rad]; NaN where the robot or the reference stands.
    lateral
        (n,) signed distance from the path, positive to its left [m].
    """

    position: FloatArray
    heading: FloatArray
    course: FloatArray
    lateral: FloatArray


def tracking_errors(
    reference: Reference, expected: ReferenceSample, true_pose: FloatArray, true_twist: FloatArray
) -> TrackingErrors:
    """Compute the error series of a run of n ticks, as defined in `TrackingErrors`.

    Parameters
    ----------
    reference
        The trajectory, of which the path is taken.
    expected
        The reference at the n ticks.
    true_pose
        (n, 3) x [m], y [m], theta [rad] at the ticks.
    true_twist
        (n, 3) forward speed [m/s], lateral speed [m/s], yaw rate [rad/s] at the ticks, body frame.
    """
    settings = metric_settings()
    polyline = path_polyline(reference, settings.path_spacing, settings.path_window)
    offset = true_pose[:, :2] - expected.pose[:, :2]
    return TrackingErrors(
        position=np.hypot(offset[:, 0], offset[:, 1]),
        heading=wrap_angle(true_pose[:, 2] - expected.pose[:, 2]),
        course=_course_error(expected, true_pose, true_twist, settings.moving_speed),
        lateral=polyline.lateral(true_pose[:, :2], expected.arc_length, settings.path_window),
    )


def _course_error(
    expected: ReferenceSample, true_pose: FloatArray, true_twist: FloatArray, moving_speed: float
) -> FloatArray:
    forward, sideways = true_twist[:, 0], true_twist[:, 1]
    reference_speed = expected.twist[:, 0]
    moving = (np.hypot(forward, sideways) > moving_speed) & (np.abs(reference_speed) > moving_speed)
    course = true_pose[:, 2] + np.arctan2(sideways, forward)
    tangent = expected.pose[:, 2] + np.where(reference_speed < 0, np.pi, 0.0)
    return np.where(moving, wrap_angle(course - tangent), np.nan)
