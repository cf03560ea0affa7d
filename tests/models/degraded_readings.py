"""Logs whose readings are wrong here and there, or whose commands teach little."""

import numpy as np
from degraded_bases import in_step, smooth_and_clipped
from degraded_changes import Case, frozen, held, replaced, rows, simulated, some_nan, spikes

READINGS = (
    Case(
        "simulated",
        "pose frozen",
        replaced(**{name: frozen(name, 1.0) for name in ("x", "y", "theta")}),
        ("no response",),
        ("pose",),
        True,
        also=("stuck sensor",),
    ),
    Case(
        "simulated",
        "pose freezes",
        replaced(**{name: frozen(name, 0.4) for name in ("x", "y", "theta")}),
        ("stuck sensor",),
        ("pose",),
    ),
    Case(
        "simulated",
        "gyro constant",
        replaced(gyro=lambda c: np.full(len(c["t"]), 0.02)),
        ("no response",),
        ("gyro",),
        True,
        also=("stuck sensor",),
    ),
    Case(
        "simulated",
        "gyro noise alone",
        replaced(gyro=lambda c: np.random.default_rng(4).normal(0, 0.3, len(c["t"]))),
        ("weak response", "no response"),
        ("gyro",),
        True,
    ),
    Case("husky", "gyro freezes", replaced(gyro_z=frozen("gyro_z", 0.4)), ("stuck sensor",), ("gyro",)),
    Case(
        "asphalt",
        "one step of 6 s",
        rows(lambda c: c["calib_step"] == 0),
        ("little excitation", "constant input"),
        ("command",),
        True,
    ),
    Case("simulated", "omega never driven", simulated(drive=(1, 0)), ("constant input",), ("omega",), True),
    Case("simulated", "v never driven", simulated(drive=(0, 1)), ("constant input",), ("v was",), True),
    Case(
        "simulated", "v and omega in step", lambda columns, base: in_step(), ("little excitation",), ("in step",), None
    ),
    Case("simulated", "gyro held", replaced(gyro=held("gyro", 4)), ("held readings",), ("gyro", "held: true")),
    Case(
        "simulated",
        "encoders held",
        replaced(left=held("left", 3), right=held("right", 3)),
        ("held readings",),
        ("encoders", "held: true"),
    ),
    Case(
        "simulated",
        "encoders coarse and held",
        replaced(
            left=lambda c: np.round(held("left", 4)(c) / 0.4) * 0.4,
            right=lambda c: np.round(held("right", 4)(c) / 0.4) * 0.4,
        ),
        ("held readings",),
        ("encoders", "held: true"),
    ),
    Case("simulated", "NaN rows", replaced(left=some_nan("left")), ("NaN rows",), ("left",)),
    Case("husky", "1 % spikes of a wheel", spikes(("wheel_left",), 60.0), ("spikes",), ("encoders",)),
    Case("simulated", "1 % spikes of the gyro", spikes(("gyro",), 30.0), ("spikes",), ("gyro",)),
    Case("simulated", "1 % spikes of the encoders", spikes(("left", "right"), 40.0), ("spikes",), ("encoders",)),
    Case("simulated", "poses jump", spikes(("x",), 15.0), ("spikes",), ("pose",)),
    Case(
        "simulated",
        "gyro empty",
        replaced(gyro=lambda c: np.full(len(c["t"]), np.nan)),
        ("empty column",),
        ("gyro",),
        True,
    ),
    Case(
        "husky",
        "encoders empty",
        replaced(wheel_left=lambda c: np.full(len(c["t"]), np.nan)),
        ("empty column",),
        ("wheel_left",),
        True,
    ),
    Case("simulated", "robot clips omega", simulated(clip=0.9, seed=23), ("clipped response",), ("omega",)),
    Case(
        "simulated", "commands rest at a limit", lambda columns, base: smooth_and_clipped(), ("saturation",), ("limit",)
    ),
)
