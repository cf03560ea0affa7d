"""Tracking errors of the true pose relative to the reference over time, and thresholds of the metrics."""

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
    """Thresholds of the statistics of tracking errors."""

    band: Positive = Field(description="half width of the lateral band [m]")
    moving_speed: Positive = Field(description="minimum speed at which the course error is computed [m/s]")
    end_error: Positive = Field(description="maximum distance of a completed run from the end of the reference [m]")
    covered_share: Positive = Field(description="minimum distance of a completed run, as a share of its path [-]")
    path_window: Positive = Field(
        description="arc length before and after the reference in which the nearest point is searched [m]"
    )
    path_spacing: Positive = Field(description="spacing of the polyline that approximates the path [m]")
    settled_arc: Positive = Field(description="duration of constant twist after which an arc counts as steady [s]")


@cache
def metric_settings() -> MetricSettings:
    """Read the thresholds of the package; raise ConfigError if the file is invalid."""
    return load_checked(MetricSettings, Path(__file__).parent / "metrics.yaml")


@dataclass(frozen=True, repr=False)
class TrackingErrors(ReadOnlyArrays):
    """Error series over the n ticks of a run.

    Attributes
    ----------
    position
        (n,) distance to the reference at the same time [m].
    heading
        (n,) true heading minus reference heading at the same time, wrapped [rad].
    course
        (n,) direction of travel, including side-slip, minus the tangent of the path at the reference of the same time
        (not at the nearest path point), wrapped [rad]; NaN if the robot or the reference is at rest.
    lateral
        (n,) signed distance from the path, positive to the left [m].
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
        Reference that defines the path.
    expected
        Samples of the reference at the n ticks.
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
