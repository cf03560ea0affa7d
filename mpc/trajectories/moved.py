"""Transformation of trajectories to another pose, and scaling to another robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.two_sided import side_of
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig, Limits
from diffdrive_mpc.mpc.trajectories.arcs import ArcTrajectory
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits, load_settings
from diffdrive_mpc.mpc.trajectories.load import load_segment_file
from diffdrive_mpc.mpc.trajectories.native import NativeTrajectory
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments


@dataclass(frozen=True, eq=False)
class MovedReference:
    """Reference that is rotated about the origin and then translated; implements `models.interface.Reference`.

    Attributes
    ----------
    original
        Original reference.
    motion
        (3,) translation x, y [m] after the rotation by theta [rad].
    """

    original: Reference
    motion: FloatArray

    @property
    def name(self) -> str:
        """Name of the original reference."""
        return self.original.name

    @property
    def duration(self) -> float:
        """Duration of the original reference [s]."""
        return self.original.duration

    @cached_property
    def native(self) -> NativeTrajectory | None:
        """Moved reference in the compiled core; None if the core cannot sample the original."""
        native = getattr(self.original, "native", None)
        # `NativeTrajectory.moved` replaces a motion, so a reference that already has one is sampled in Python.
        if not isinstance(native, NativeTrajectory) or any(native.struct.motion):
            return None
        return native.moved(self.motion)

    def __getstate__(self) -> dict[str, object]:
        """Return the state without `native`, which holds memory of the core."""
        return {name: value for name, value in self.__dict__.items() if name != "native"}

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Sample at `times` (n,) [s]; twist and arc length are those of the original reference."""
        sample = self.original.sample(times)
        x, y, theta = self.motion
        cos, sin = np.cos(theta), np.sin(theta)
        pose = np.empty_like(sample.pose)
        pose[:, 0] = x + cos * sample.pose[:, 0] - sin * sample.pose[:, 1]
        pose[:, 1] = y + sin * sample.pose[:, 0] + cos * sample.pose[:, 1]
        pose[:, 2] = theta + sample.pose[:, 2]
        return sample._replace(pose=pose)


def starting_at(reference: Reference, pose: ArrayLike) -> MovedReference:
    """Rotate and translate `reference` so that it starts at `pose` (3,) x, y [m], theta [rad]."""
    start = reference.sample([0.0]).pose[0]
    x, y, theta = np.asarray(pose, dtype=float)
    turn = theta - start[2]
    cos, sin = np.cos(turn), np.sin(turn)
    return MovedReference(
        reference, np.array([x - cos * start[0] + sin * start[1], y - sin * start[0] - cos * start[1], turn])
    )


_MIN_LAG = 1e-3
"""Lower bound of the lag in the acceleration limits [s], against division by zero."""
_RADIUS_MARGIN = 1.2
"""Ratio of the minimum radius of a scaled path to that of the robot [-]; the reserve is for tracking corrections."""


def scaled_to_robot(
    name_or_path: str | Path, config: ControllerConfig, model: VelocityModel | NonlinearModel
) -> ArcTrajectory:
    """Scale a path of segments by the ratio of the robot's track to that of the robot of the papers.

    For a robot with a minimum turn radius, the path is enlarged further if necessary. The robot stops where the
    curvature jumps. The speed is a share of the robot's maximum speed, which is the command limit times the
    steady-state gain of the model, within the wheel speed limit. The acceleration is within a share of the slew limit.
    It is also within a share of the remaining command: due to the lag, an acceleration requires an additional command
    of lag times acceleration. The shares are in `settings.yaml`.

    Parameters
    ----------
    name_or_path
        Name or path of a trajectory of segments.
    config
        Limits and wheels of the robot.
    model
        Model of the robot.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the trajectory does not exist, does not consist of segments, or has a turn on the spot that a limit forbids.
    """
    file, settings, limits = load_segment_file(name_or_path), load_settings(), config.limits
    segments = file.segments
    (v_gain, omega_gain), (v_lag, omega_lag) = np.abs(np.diag(model.dc_gain)).tolist(), model.lag.tolist()
    length = config.wheels.encoder_track / load_robot().track
    if limits.min_path_radius:
        length = max(length, _RADIUS_MARGIN * limits.min_path_radius / _min_radius(segments, name_or_path, limits))
    # Ratio of the required commands and wheel speeds to their limits for each segment with its duration in the file.
    shares = [
        max(
            length * abs(segment.v) / (v_gain * side_of(limits.v, segment.v)),
            abs(segment.omega) / (omega_gain * side_of(limits.omega, segment.omega)),
            (length * abs(segment.v) / v_gain + 0.5 * config.wheels.track * abs(segment.omega) / omega_gain)
            / limits.wheel_speed,
        )
        for segment in segments
    ]
    factor = max(shares) / settings.reach_share
    scaled = [
        Segment(v=segment.v * length / factor, omega=segment.omega / factor, duration=segment.duration * factor)
        for segment in segments
    ]
    max_values = [max(abs(getattr(segment, name)) for segment in scaled) for name in ("v", "omega")]
    usual, slew = load_robot().reference_acceleration, settings.slew_share
    remaining_share = slew * (1.0 - settings.reach_share)
    bounds = TrajectoryLimits(
        v=max(max_values[0], v_gain * max(limits.v.sides)),
        omega=max(max_values[1], omega_gain * max(limits.omega.sides)),
        v_acceleration=min(
            # Lengths are scaled by `length` and times by `factor`.
            usual.v * length / factor**2,
            slew * v_gain * limits.v_slew,
            remaining_share * v_gain * limits.v / max(v_lag, _MIN_LAG),
        ),
        omega_acceleration=min(
            usual.omega / factor**2,
            slew * omega_gain * limits.omega_slew,
            remaining_share * omega_gain * limits.omega / max(omega_lag, _MIN_LAG),
        ),
    )
    name = f"{file.name or Path(name_or_path).stem} scaled to the robot"
    path = time_segments(scaled, bounds, name=name, where=str(name_or_path))
    durations = f"{sum(segment.duration for segment in segments):.1f} s in the file, driven in {path.duration:.1f} s"
    return replace(path, remark=f"trajectory '{path.name}': {length:.3g} times the lengths of the file; {durations}")


def _min_radius(segments: Sequence[Segment], path: str | Path, limits: Limits) -> float:
    """Return the minimum radius of a path [m]; raise ConfigError if it turns on the spot."""
    turning = [segment for segment in segments if segment.omega]
    if any(segment.v == 0.0 for segment in turning):
        name = "min_turn_radius" if limits.min_turn_radius else "min_commanded_radius"
        raise ConfigError(f"{path}: it turns on the spot, which limits.{name} forbids; give a path of arcs like circle")
    return min((abs(segment.v / segment.omega) for segment in turning), default=math.inf)
