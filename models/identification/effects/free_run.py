"""Simulated readings of encoders and gyro for a robot with base effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from diffdrive_mpc.models.base_effects import PARTS, TwistSlew, WheelCommand, YawRelaxation
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, YawSource, twist_experiments
from diffdrive_mpc.models.two_sided import BaseSlewLimit

SENSORS = ("v", "omega of the encoders", "omega of the gyro")


def sensor_experiments(records: Sequence[Record], yaw: YawSource = "gyro") -> list[SampledExperiment]:
    """Build experiments: inputs v_ref and omega_ref, outputs v and omega of the encoders and omega of the gyro.

    Raises
    ------
    ValueError
        If a record lacks a sensor, has too few readings, or has values that are not finite.
    """
    if yaw != "gyro":
        return twist_experiments(records, yaw)
    wheel_experiments, gyro_experiments = twist_experiments(records, "encoders"), twist_experiments(records, "gyro")
    return [
        SampledExperiment(
            wheels.name,
            wheels.dt,
            wheels.inputs,
            np.column_stack([wheels.outputs, body.outputs[:, 1]]),
            np.column_stack([wheels.counts, body.counts[:, 1]]),
            wheels.follows and body.follows,
        )
        for wheels, body in zip(wheel_experiments, gyro_experiments, strict=True)
    ]


Point = Mapping[str, float]
"""Values of parameters by name; parameters of absent effects are missing."""


def free_run(point: Point, experiment: SampledExperiment, *, smooth: bool = False) -> FloatArray:
    """Simulate the readings (K, p) of an experiment from its commands and first readings.

    The readings are v and omega of the encoders, and omega of the gyro. The simulation is that of
    `models.base_effects.respond`, in units of the encoders, followed by the sensors. The robot is assumed to be in
    steady state at the first readings.

    Parameters
    ----------
    point
        Parameters of base and sensors.
    experiment
        Commands (K, 2) and readings (K, p); p is 3, or 2 without a gyro.
    smooth
        True to replace the steps of the wheel command by a differentiable approximation.
    """
    step = experiment.dt / PARTS
    first = experiment.first_readings
    start = np.array([first[0] / point["gain.v"], first[1] / (point["gain.omega"] * point["encoders.yaw_ratio"])])
    motor_twist = _motor_twist(point, np.repeat(experiment.inputs, PARTS, axis=0), step, start, smooth)
    gains = np.array([point["gain.v"], point["gain.omega"]])
    wheels = np.empty_like(motor_twist)
    for row, channel in enumerate(("v", "omega")):
        delayed = _apply_delay(motor_twist[:, row], start[row], point[f"dead_time.{channel}"] / step)
        wheels[:, row] = gains[row] * two_lags(
            delayed, start[row], point[f"lag.{channel}"], point.get(f"damping.{channel}", 1.0), step
        )
    gyro = wheels[:, 1]
    if "relaxation" in point:
        gyro = YawRelaxation.model_construct(angle=point["relaxation"]).follow(gyro, step, float(np.sign(gyro[0])))
    gyro = gyro + point.get("veer", 0.0) * wheels[:, 0] + point["gyro.offset"]
    readings = wheels * np.array([1.0, point["encoders.yaw_ratio"]])
    if "encoders.lag" in point:
        readings = _apply_lag(readings, point["encoders.lag"], step)
    reading_times = PARTS * np.arange(experiment.samples) - point["encoders.delay"] / step
    time_grid = np.arange(len(readings))
    encoder_readings = [np.interp(reading_times, time_grid, column) for column in readings.T]
    return np.column_stack([*encoder_readings, gyro[::PARTS]][: experiment.outputs.shape[1]])


def two_lags(drive: FloatArray, start: float, lag: float, damping: float, step: float) -> FloatArray:
    """Compute the exact response (K,) of two poles to a zero-order-hold input, from steady state at `start`.

    Parameters
    ----------
    drive
        Input (K,), constant over each step.
    start
        Initial input and output.
    lag
        Inverse of the natural frequency [s].
    damping
        Damping ratio [-]; below 1 the poles are complex.
    step
        Time between samples [s].
    """
    root = np.emath.sqrt(damping**2 - 1.0)
    slow, fast = lag * (damping + root), lag / (damping + root)
    a, b = np.exp(-step / slow), np.exp(-step / fast)
    if abs(root) > 1e-4:
        rise = 1.0 - (slow * a - fast * b) / (slow - fast)
    else:  # limit of equal poles
        a = b = np.exp(-step / lag)
        rise = 1.0 - a * (1.0 + step / lag)
    numerator = np.real([0.0, rise, (1.0 - a) * (1.0 - b) - rise])
    from scipy import signal  # noqa: PLC0415 - loads slowly, and loading a model does not need it

    return np.asarray(start + signal.lfilter(numerator, np.real([1.0, -(a + b), a * b]), drive - start))


def _motor_twist(point: Point, commands: FloatArray, step: float, start: FloatArray, smooth: bool) -> FloatArray:
    """Compute the twist (n, 2) that the motors are commanded to track."""
    maximum = np.array([point.get("limit.v", np.inf), point.get("limit.omega", np.inf)])
    motor_twist = np.clip(commands, -maximum, maximum)
    if "slew.v" in point:
        motor_twist = TwistSlew.model_construct(
            v=BaseSlewLimit(point["slew.v"]), omega=BaseSlewLimit(point["slew.omega"])
        ).follow(motor_twist, step, start)
    if "encoders.track" not in point:
        return motor_twist
    base = WheelCommand.model_construct(
        track=base_track(point),
        resolution=point.get("wheels.resolution", 0.0),
        coasting_speed=point.get("wheels.coasting", 0.0),
        top_speed=point.get("wheels.top_speed"),
    )
    return smooth_command(base, motor_twist) if smooth and base.resolution else base.apply(motor_twist)


def base_track(point: Point) -> float:
    """Compute the track [m] for the base's conversion of omega_ref to rim speeds.

    Both sides respond equally to a commanded rim speed. The track is therefore the encoders' track times the ratio of
    the encoders' gain in turns to their gain in straight motion.
    """
    turn_gain = point["gain.omega"] * point["encoders.yaw_ratio"]
    return point["encoders.track"] * turn_gain / point["gain.v"]


def smooth_command(base: WheelCommand, twist: FloatArray) -> FloatArray:
    """Apply `base` with smooth approximations of its steps and of the onset of coasting."""
    sides = base.sides(twist)
    if base.top_speed is not None:
        sides = np.clip(sides, -base.top_speed, base.top_speed)
    quantised = sides - 0.5 * base.resolution * np.tanh(sides / base.resolution)
    square = (sides / base.resolution) ** 2
    idle_share = 1.0 / (1.0 + (square * square) ** 2)  # the eighth power by squaring, ten times faster
    coasting = idle_share * (1.0 - idle_share[..., ::-1])
    coasting_speed = np.clip(quantised[..., ::-1], -base.coasting_speed, base.coasting_speed)
    return base.twist(quantised + coasting * (coasting_speed - quantised))


def _apply_delay(values: FloatArray, initial: float, steps: float) -> FloatArray:
    """Delay `values` (n,) by `steps` steps with linear interpolation; `initial` is the value before the first step."""
    whole = int(steps)
    history = np.concatenate([np.full(whole + 1, initial), values])
    fraction = steps - whole
    return np.asarray((1.0 - fraction) * history[1 : 1 + len(values)] + fraction * history[: len(values)])


def _apply_lag(values: FloatArray, lag: float, step: float) -> FloatArray:
    """Apply a first-order lag [s] to `values` (n, 2), starting in steady state."""
    decay = np.exp(-step / lag)
    deviation = values - values[0]
    from scipy import signal  # noqa: PLC0415 - loads slowly, and loading a model does not need it

    return np.asarray(values[0] + signal.lfilter([0.5 * (1 - decay)] * 2, [1.0, -decay], deviation, axis=0))
