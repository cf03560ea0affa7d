"""From a playback to the shots that MuJoCo paints: no simulation, the recorded poses and wheel speeds."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.app.animation.film import Film
from diffdrive_mpc.app.animation.playback import Playback
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from diffdrive_mpc.sim.view.body import Body
from diffdrive_mpc.sim.view.shots import Shots


def shots_of(playback: Playback, film: Film, body: Body, size: tuple[int, int]) -> Shots:
    """The shots of a film, `size` pixels wide and high."""
    times = film.times(playback)
    instants = playback.instants(times)
    first, last = playback.instants(np.array(film.span(playback))).tolist()
    plans = playback.plans[instants, :, :2] if playback.plans.size else np.empty((len(times), 0, 2))
    angles = wheel_angles(playback, body)
    return Shots(
        time=times,
        poses=_held(playback.at(times)),
        wheel_angles=np.column_stack([np.interp(times, playback.time, column) for column in angles.T]),
        passed=instants + 1 - first,
        plans=plans,
        way=playback.pose[first : last + 1, :2],
        reference=playback.reference[:, :2],
        band=metric_settings().band,
        body=body,
        surface=film.surface,
        camera=film.camera,
        size=size,
    )


def wheel_angles(playback: Playback, body: Body) -> FloatArray:
    """(n, 4) angles [rad] from the measured wheel speeds; without them from the motion, as if nothing slipped."""
    rolling = WheelKinematics(body.wheel_radius, body.track).wheel_speeds(playback.twist)
    speeds = playback.wheel_speeds if playback.wheel_speeds.size else rolling
    speeds = np.nan_to_num(np.where(np.isfinite(speeds), speeds, rolling))
    steps = np.diff(playback.time)[:, None] * 0.5 * (speeds[1:] + speeds[:-1])
    return np.concatenate([np.zeros((1, 4)), np.cumsum(steps, axis=0)])


def _held(poses: FloatArray) -> FloatArray:
    """Where nothing is known the last known pose, and before that the first."""
    known = np.flatnonzero(np.isfinite(poses).all(axis=1))
    if not known.size:
        return np.nan_to_num(poses)
    last = np.maximum(np.searchsorted(known, np.arange(len(poses)), side="right") - 1, 0)
    return np.asarray(poses[known[last]])
