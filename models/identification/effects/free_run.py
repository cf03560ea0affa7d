"""Simulated readings of encoders and gyro, for a robot that follows its commands with the effects of its base."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from diffdrive_mpc.models.base_effects import PARTS, TwistSlew, WheelCommand, YawRelaxation
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, YawSource, twist_experiments
from diffdrive_mpc.models.two_sided import BaseSlewLimit

SENSORS = ("v", "omega of the encoders", "omega of the gyro")


def sensed(records: Sequence[Record], yaw: YawSource = "gyro") -> list[SampledExperiment]:
    """Build experiments of commands (v_ref, omega_ref) against v and omega of the encoders and omega of the gyro.

    Raises
    ------
    ValueError
        If a record lacks a sensor, has too few readings, or is not finite.
    """
    if yaw != "gyro":
        return twist_experiments(records, yaw)
    by_encoders, by_gyro = twist_experiments(records, "encoders"), twist_experiments(records, "gyro")
    return [
        SampledExperiment(
            wheels.name,
            wheels.dt,
            wheels.inputs,
            np.column_stack([wheels.outputs, body.outputs[:, 1]]),
            np.column_stack([wheels.counts, body.counts[:, 1]]),
            wheels.follows and body.follows,
        )
        for wheels, body in zip(by_encoders, by_gyro, strict=True)
    ]


Point = Mapping[str, float]
"""Values of parameters by name; an effect without parameters is absent."""


def free_run(point: Point, experiment: SampledExperiment, *, smooth: bool = False) -> FloatArray:
    """Simulate (K, p) v and omega of the encoders, omega of the gyro, from the commands and the first readings.

    The same chain as `models.base_effects.respond`, from encoders' units, and the sensors behind it. The robot is
    assumed to be in steady state at its first readings.

    Parameters
    ----------
    point
        The parameters.
    experiment
        The commands (K, 2) and readings (K, p); p is 3, or 2 without a gyro.
    smooth
        Whether the steps of the wheel command are smoothed to their mean, which has slopes.
    """
    step = experiment.dt / PARTS
    first = experiment.first_readings
    start = np.array([first[0] / point["gain.v"], first[1] / (point["gain.omega"] * point["encoders.yaw_ratio"])])
    requested = _asked(point, np.repeat(experiment.inputs, PARTS, axis=0), step, start, smooth)
    gains = np.array([point["gain.v"], point["gain.omega"]])
    wheels = np.empty_like(requested)
    for row, channel in enumerate(("v", "omega")):
        drive = _late(requested[:, row], start[row], point[f"dead_time.{channel}"] / step)
        wheels[:, row] = gains[row] * two_lags(
            drive, start[row], point[f"lag.{channel}"], point.get(f"damping.{channel}", 1.0), step
        )
    gyro = wheels[:, 1]
    if "relaxation" in point:
        gyro = YawRelaxation.model_construct(angle=point["relaxation"]).follow(gyro, step, float(np.sign(gyro[0])))
    gyro = gyro + point.get("veer", 0.0) * wheels[:, 0] + point["gyro.offset"]
    readings = wheels * np.array([1.0, point["encoders.yaw_ratio"]])
    if "encoders.lag" in point:
        readings = _lagging(readings, point["encoders.lag"], step)
    instants = PARTS * np.arange(experiment.samples) - point["encoders.delay"] / step
    fine = np.arange(len(readings))
    by_encoders = [np.interp(instants, fine, column) for column in readings.T]
    return np.column_stack([*by_encoders, gyro[::PARTS]][: experiment.outputs.shape[1]])


def two_lags(drive: FloatArray, start: float, lag: float, damping: float, step: float) -> FloatArray:
    """Compute the exact zero-order-hold response (K,) of two poles that start at rest at `start`.

    Parameters
    ----------
    drive
        (K,) input, each value held over one step.
    start
        Input and output before.
    lag
        One over the natural frequency [s].
    damping
        Below 1 the poles are complex [-].
    step
        Time between samples [s].
    """
    root = np.emath.sqrt(damping**2 - 1.0)
    slow, fast = lag * (damping + root), lag / (damping + root)
    a, b = np.exp(-step / slow), np.exp(-step / fast)
    if abs(root) > 1e-4:
        rise = 1.0 - (slow * a - fast * b) / (slow - fast)
    else:  # the limit of equal poles
        a = b = np.exp(-step / lag)
        rise = 1.0 - a * (1.0 + step / lag)
    numerator = np.real([0.0, rise, (1.0 - a) * (1.0 - b) - rise])
    from scipy import signal  # noqa: PLC0415 - loads slowly, and who only loads a model does without it

    return np.asarray(start + signal.lfilter(numerator, np.real([1.0, -(a + b), a * b]), drive - start))


def _asked(point: Point, commands: FloatArray, step: float, start: FloatArray, smooth: bool) -> FloatArray:
    """Compute the twist (n, 2) that the motors are commanded."""
    most = np.array([point.get("limit.v", np.inf), point.get("limit.omega", np.inf)])
    requested = np.clip(commands, -most, most)
    if "slew.v" in point:
        requested = TwistSlew.model_construct(
            v=BaseSlewLimit(point["slew.v"]), omega=BaseSlewLimit(point["slew.omega"])
        ).follow(requested, step, start)
    if "encoders.track" not in point:
        return requested
    base = WheelCommand.model_construct(
        track=base_track(point),
        resolution=point.get("wheels.resolution", 0.0),
        coasting_speed=point.get("wheels.coasting", 0.0),
        top_speed=point.get("wheels.top_speed"),
    )
    return smoothed(base, requested) if smooth and base.resolution else base.apply(requested)


def base_track(point: Point) -> float:
    """Track [m] by which the base turns omega_ref into rim speeds.

    Both sides respond equally to a commanded rim speed, so it is the encoders' track times their gain in turning over
    that in driving straight.
    """
    turning = point["gain.omega"] * point["encoders.yaw_ratio"]
    return point["encoders.track"] * turning / point["gain.v"]


def smoothed(base: WheelCommand, twist: FloatArray) -> FloatArray:
    """Apply `base` without jumps: each step is replaced by its mean, and coasting sets in over half a step."""
    sides = base.sides(twist)
    if base.top_speed is not None:
        sides = np.clip(sides, -base.top_speed, base.top_speed)
    held = sides - 0.5 * base.resolution * np.tanh(sides / base.resolution)
    square = (sides / base.resolution) ** 2
    unheld = 1.0 / (1.0 + (square * square) ** 2)  # the eighth power by squares, which costs a tenth
    coasting = unheld * (1.0 - unheld[..., ::-1])
    along = np.clip(held[..., ::-1], -base.coasting_speed, base.coasting_speed)
    return base.twist(held + coasting * (along - held))


def _late(values: FloatArray, before: float, steps: float) -> FloatArray:
    """Delay values (n,) by `steps` steps, with `before` at first; interpolate between two steps."""
    whole = int(steps)
    line = np.concatenate([np.full(whole + 1, before), values])
    rest = steps - whole
    return np.asarray((1.0 - rest) * line[1 : 1 + len(values)] + rest * line[: len(values)])


def _lagging(values: FloatArray, lag: float, step: float) -> FloatArray:
    """Apply a first-order lag [s] to `values`, settled at the first: (n, 2)."""
    keep = np.exp(-step / lag)
    change = values - values[0]
    from scipy import signal  # noqa: PLC0415 - loads slowly, and who only loads a model does without it

    return np.asarray(values[0] + signal.lfilter([0.5 * (1 - keep), 0.5 * (1 - keep)], [1.0, -keep], change, axis=0))
