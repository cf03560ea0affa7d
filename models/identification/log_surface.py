"""The surface that a log was driven on, as far as gyro and encoders tell it: for a model plant of the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from diffdrive_mpc.models.logs.record import Record

SURFACE_FILE = "surface.yaml"


def log_surface(records: Sequence[Record]) -> dict[str, dict[str, float]]:
    """Return keys and values of a surface file: the yaw rate of the body over that of the encoders.

    Without a gyro the model's omega is that of the encoders, and the body is taken to turn as they say.
    """
    both = [
        (record.yaw_rate[used], record.twist[used, 1])
        for record in records
        if record.yaw_rate is not None and record.twist is not None
        for used in [np.isfinite(record.yaw_rate) & np.isfinite(record.twist[:, 1])]
    ]
    ratio = 1.0
    if both:
        body, wheels = (np.concatenate(values) for values in zip(*both, strict=True))
        ratio = float(body @ wheels / (wheels @ wheels))
    slip = {"yaw_gain": 1.0, "wheel_yaw_gain": float(f"{ratio:.4g}"), "longitudinal_gain": 1.0, "side_slip": 0.0}
    return {"slip": slip}


def surface_text(surface: Mapping[str, Mapping[str, float]]) -> str:
    """Return the surface file, with a reason beside each value."""
    reasons = {
        "yaw_gain": "true yaw rate over that of the model, which is the log's",
        "wheel_yaw_gain": "true yaw rate over that of the encoders, by the gyro of the log; 1 without one",
        "longitudinal_gain": "true forward speed over that of the encoders; not in the log",
        "side_slip": "s, lateral speed over v * omega; not in the log",
    }
    lines = [f"  {name}: {value}   # {reasons[name]}" for name, value in surface["slip"].items()]
    return "\n".join(["# Surface of the log, for `simulate --surface` with a model: plant.", "slip:", *lines]) + "\n"
