"""A trajectory laid somewhere else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
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
from diffdrive_mpc.mpc.trajectories.load import load_segments
from diffdrive_mpc.mpc.trajectories.native import NativeTrajectory
from diffdrive_mpc.mpc.trajectories.segments import Segment, lay_segments


@dataclass(frozen=True, eq=False)
class MovedReference:
    """A reference turned about the origin and then moved; satisfies `models.interface.Reference`.

    Attributes
    ----------
    original
        The reference as it was.
    motion
        (3,) x, y [m] by which it is moved after it was turned by theta [rad].
    """

    original: Reference
    motion: FloatArray

    @property
    def name(self) -> str:
        """Name of the original."""
        return self.original.name

    @property
    def duration(self) -> float:
        """Duration of the original [s]."""
        return self.original.duration

    @cached_property
    def native(self) -> NativeTrajectory | None:
        """The same in the compiled core, if it can sample the original."""
        native = getattr(self.original, "native", None)
        if not isinstance(native, NativeTrajectory) or any(native.struct.motion):
            return None
        return native.moved(self.motion)

    def __getstate__(self) -> dict[str, object]:
        """Copy the state without the memory of C."""
        return {name: value for name, value in self.__dict__.items() if name != "native"}

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s]; twist and arc length are the original's."""
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
        reference,
        np.array([x - cos * start[0] + sin * start[1], y - sin * start[0] - cos * start[1], turn]),
    )


# A path of segments for a robot of another size and speed than the one that it was laid out for.


_AT_ONCE = 1e-3
"""A robot with less lag answers at once [s]."""
_ROOM = 1.2
"""Tightest turn of a scaled path over the least one that the robot may drive [-]: holding the path takes the rest."""


def scaled_to_robot(
    name_or_path: str | Path, config: ControllerConfig, model: VelocityModel | NonlinearModel
) -> ArcTrajectory:
    """Scale a path of segments by the robot's track over that of the robot of the papers.

    A robot with a minimum turn radius gets a path whose tightest turn is wider. Its speed is a share of what the robot
    can reach, and it stops where the curvature jumps. A robot reaches its limits of the command times the model's
    steady-state gain, as far as its wheels get so fast, and follows a share of its limits of the slew. As it answers
    late, an acceleration takes its lag's worth more command: the same share of what the speed leaves. The shares are in
    `settings.yaml`.

    Parameters
    ----------
    name_or_path
        A trajectory made of segments.
    config
        Limits and wheels of the robot.
    model
        Model of the robot.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such trajectory, it is not made of segments, or it turns on the spot where the robot may not.
    """
    segments, settings, limits = load_segments(name_or_path), load_settings(), config.limits
    (v_gain, omega_gain), (v_lag, omega_lag) = np.abs(np.diag(model.dc_gain)).tolist(), model.lag.tolist()
    length = config.wheels.encoder_track / load_robot().track
    if limits.min_path_radius:
        length = max(length, _ROOM * limits.min_path_radius / _tightest(segments, name_or_path, limits))
    # Shares of commands and wheels that each segment would take, were it as long as in the file.
    taken = [
        max(
            length * abs(segment.v) / (v_gain * side_of(limits.v, segment.v)),
            abs(segment.omega) / (omega_gain * side_of(limits.omega, segment.omega)),
            (length * abs(segment.v) / v_gain + 0.5 * config.wheels.track * abs(segment.omega) / omega_gain)
            / limits.wheel_speed,
        )
        for segment in segments
    ]
    slower = max(taken) / settings.reach_share
    scaled = [
        Segment(v=segment.v * length / slower, omega=segment.omega / slower, duration=segment.duration * slower)
        for segment in segments
    ]
    fastest = [max(abs(getattr(segment, name)) for segment in scaled) for name in ("v", "omega")]
    usual, slew = load_robot().reference_acceleration, settings.slew_share
    left = slew * (1.0 - settings.reach_share)
    bounds = TrajectoryLimits(
        v=max(fastest[0], v_gain * max(limits.v.sides)),
        omega=max(fastest[1], omega_gain * max(limits.omega.sides)),
        v_acceleration=min(
            usual.v * length / slower**2, slew * v_gain * limits.v_slew, left * v_gain * limits.v / max(v_lag, _AT_ONCE)
        ),
        omega_acceleration=min(
            usual.omega / slower**2,
            slew * omega_gain * limits.omega_slew,
            left * omega_gain * limits.omega / max(omega_lag, _AT_ONCE),
        ),
    )
    return lay_segments(scaled, bounds, name=f"{Path(name_or_path).stem} scaled to the robot", where=str(name_or_path))


def _tightest(segments: Sequence[Segment], path: str | Path, limits: Limits) -> float:
    """Return the minimum radius of a path [m]; raise ConfigError where it turns on the spot."""
    turning = [segment for segment in segments if segment.omega]
    if any(segment.v == 0.0 for segment in turning):
        name = "min_turn_radius" if limits.min_turn_radius else "min_commanded_radius"
        raise ConfigError(f"{path}: it turns on the spot, which limits.{name} forbids; give a path of arcs, as circle")
    return min((abs(segment.v / segment.omega) for segment in turning), default=math.inf)
