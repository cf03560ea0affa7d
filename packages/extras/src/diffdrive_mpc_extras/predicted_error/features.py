"""What of a reference and a robot makes a tracking error, at each place of the path."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import ControllerConfig, Failure

FEATURES = {
    "floor": "noise of sensors and floor",
    "pose_age": "late or rare poses",
    "speed": "speed and lag",
    "turning": "curvature at speed",
    "acceleration": "change of speed and lag",
    "yaw_acceleration": "change of curvature and lag",
    "first_turns": "first turns (slip is still learned)",
    "wheel_speed": "wheels near their top speed",
    "pose_age_at_speed": "late or rare poses at speed",
}
"""By name what a report calls them; lag is that of the model with its dead time. The error grows with each.

Turns driven before a place make `first_turns` smaller there: slip is learned from them."""
_BEFORE, _AFTER = 1.0, 0.3
"""Features are means from so long before a place to after it [s]: an error outlasts its cause; look-ahead is early."""
_LEARNED = 1.0
"""The effect of what is not yet learned decays with the angle that was turned [rad]."""
_FREE_SHARE = 0.6
"""Share of the top speed of wheels from which on it counts."""
_USUAL_AGE = Failure().max_pose_age
"""Who waits longer for poses than usual has late or rare ones [s]."""


def path_features(twist: FloatArray, dt: float, config: ControllerConfig, lag: FloatArray) -> FloatArray:
    """Features of a reference at each of its samples.

    Parameters
    ----------
    twist
        (n, 2) v [m/s], omega [rad/s] of the reference, n at least 2.
    dt
        Time between two samples [s].
    config
        Tracks, wheel speeds and pose ages that it states.
    lag
        (2,) mean delay of both channels of the model, dead time included [s].

    Returns
    -------
    FloatArray
        (n, len(FEATURES)), none negative, in the order of `FEATURES`.
    """
    v, omega = np.abs(twist).T
    dv, domega = np.abs(np.gradient(twist, dt, axis=0)).T
    turned = np.cumsum(omega) * dt
    share = (v + omega * config.wheels.track / 2) / config.limits.wheel_speed
    age = max(config.failure.max_pose_age - _USUAL_AGE, 0.0)
    values = {
        "floor": np.ones_like(v),
        "pose_age": np.full_like(v, age),
        "speed": lag[0] * v,
        "turning": omega,
        "acceleration": lag[0] * dv,
        "yaw_acceleration": lag[1] * v * domega,
        "first_turns": v * omega * np.exp(-turned / _LEARNED),
        "wheel_speed": np.maximum(share - _FREE_SHARE, 0.0),
        "pose_age_at_speed": age * v,
    }
    return _around(np.column_stack([values[name] for name in FEATURES]), dt)


def _around(values: FloatArray, dt: float) -> FloatArray:
    """Means of the columns from `_BEFORE` to `_AFTER` each row; beyond the ends the first and last rows continue."""
    before, after = round(_BEFORE / dt), round(_AFTER / dt)
    longer = np.pad(values, ((before + 1, after), (0, 0)), mode="edge")
    sums = np.cumsum(longer, axis=0)
    return np.asarray((sums[before + after + 1 :] - sums[: -(before + after + 1)]) / (before + after + 1))
