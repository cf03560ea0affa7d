"""Logs of drawn robots with a known truth: builds of the market in a simulation that shares no code with the estimate.

Commands are clipped, ramped, delayed and lagged in steps of a millisecond; wheels have radii of their own and turn the
body by a wider track; sensors are noisy, late and biased. What no model explains is a disturbance of the speeds that is
correlated over half a second.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy import signal

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.identification.log_data import LogData, divide
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.sim.plants.drawn_robot import Range, draw_robot

_FINE = 1e-3
"""Step of the simulation [s]."""


class StackPopulation(StrictModel):
    """Ranges of what the market does not say; units in `population.yaml`."""

    seconds: float
    sample_time: float
    hold: Range
    speed: Range
    turning: Range
    widening: Range
    limit: Range
    slew_time: Range
    second_lag: Range
    gyro_bias: Range
    wheel_noise: float
    gyro_noise: float
    disturbance: float
    correlation: float
    tolerances: dict[str, float]


@cache
def load_population() -> StackPopulation:
    """Read the ranges; raises ConfigError on a mistake in them."""
    return load_checked(StackPopulation, Path(__file__).with_suffix(".yaml"))


@dataclass(frozen=True)
class DrawnLog:
    """A log, and what the estimate should say of it, by the names of `estimate_stack`."""

    data: LogData
    truth: Mapping[str, float]
    reached: Mapping[str, bool]


def drawn_log(
    seed: int,
    *,
    noise: float = 1.0,
    seconds: float | None = None,
    limit: float | None = None,
    gyro: bool = True,
    pose: bool = True,
    wheels: bool = True,
) -> DrawnLog:
    """Drive the robot of a seed.

    Parameters
    ----------
    seed
        Of the robot and of its noise; nothing is tuned on even ones.
    noise
        Part of the usual noise, disturbance and bias [-].
    seconds, limit
        Other than those of the settings: how long the log is [s], and where commands are clipped [-].
    gyro, pose, wheels
        Which sensors the log has.
    """
    settings, build = load_population(), draw_robot(seed).build
    stream = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(37,)))
    draw = {
        name: float(stream.uniform(*getattr(settings, name))) for name in StackPopulation.model_fields if name in _DRAWN
    }
    dt, every, track, radius = (
        settings.sample_time,
        round(settings.sample_time / _FINE),
        build.robot.track,
        build.robot.wheel_radius,
    )
    count = round((seconds or settings.seconds) / dt)
    size = np.array([draw["speed"], draw["turning"]])
    hold = round(draw["hold"] / dt)
    command = size * np.repeat(stream.uniform(-1, 1, (count // hold + 1, 2)), hold, axis=0)[:count]
    wide = track * (1.0 if build.twin.chassis.castors else draw["widening"])
    gain = np.array([1.0, build.firmware.track / wide])
    level, slew = (limit or draw["limit"]) * size, size / draw["slew_time"]
    lags = np.array([[build.firmware.lag_v, draw["second_lag"]], [build.firmware.lag_omega, draw["second_lag"]]])
    twist = _followed(np.repeat(np.clip(command, -level, level), every, axis=0), slew, lags, build.twin.link.dead_time)
    twist = twist * gain + noise * settings.disturbance * size * gain * _coloured(
        stream, len(twist), settings.correlation
    )
    sides = np.column_stack([twist[:, 0] - 0.5 * wide * twist[:, 1], twist[:, 0] + 0.5 * wide * twist[:, 1]])
    radii = radius * np.array(build.twin.chassis.rolling_radii)
    reading = sides[::every] / radii + noise * settings.wheel_noise / radius * stream.normal(size=(count, 2))
    odometry = np.column_stack([0.5 * radius * reading.sum(axis=1), radius * np.diff(reading)[:, 0] / track])
    source = build.sensors.pose
    assert source is not None
    poses = _poses(twist, every, source.latency) + noise * stream.normal(size=(count, 3)) * [
        source.position_sd,
        source.position_sd,
        source.heading_sd,
    ]
    fresh = np.diff(np.floor(dt * np.arange(-1, count) / max(source.period or dt, dt) + 1e-9)) > 0
    rate = twist[::every, 1] + noise * (draw["gyro_bias"] + settings.gyro_noise * stream.normal(size=count))
    record = Record(
        f"robot {seed}",
        0.0,
        dt,
        command,
        twist=odometry,
        yaw_rate=rate if gyro else None,
        pose=poses if pose else None,
        wheels=reading if wheels else None,
        fresh_pose=fresh if pose else None,
    )
    train, validation = divide([record], 0.75)
    data = LogData(
        tuple(train), tuple(validation), ("drawn",), "the last quarter", "gyro" if gyro else "encoders", (), (), track
    )
    late = build.twin.link.dead_time + lags.sum(axis=1)
    truth = {
        "separation_multiplier": wide / track,
        "left_radius_multiplier": radii[0] / radius,
        "right_radius_multiplier": radii[1] / radius,
        **{f"delay.{name}": float(value) for name, value in zip(("v", "omega"), late, strict=True)},
        **{f"max.{name}": float(value) for name, value in zip(("v", "omega"), gain * level, strict=True)},
        **{f"rate.{name}": float(value) for name, value in zip(("v", "omega"), gain * slew, strict=True)},
    }
    passed = np.mean(np.abs(command) > level, axis=0) > 0
    return DrawnLog(data, truth, dict(zip(("max.v", "max.omega"), passed.tolist(), strict=True)))


_DRAWN = ("hold", "speed", "turning", "widening", "limit", "slew_time", "second_lag", "gyro_bias")


def _followed(commands: FloatArray, slew: FloatArray, lags: FloatArray, dead_time: float) -> FloatArray:
    """(n, 2) what the motors do of commands (n, 2): each ramped, delayed and behind two lags."""
    ramped = np.empty_like(commands)
    now = np.zeros(2)
    for k, wanted in enumerate(commands):
        ramped[k] = now
        now = now + np.clip(wanted - now, -slew * _FINE, slew * _FINE)
    late = round(dead_time / _FINE)
    ramped = np.concatenate([np.zeros((late, 2)), ramped])[: len(commands)]
    for row in range(2):
        for lag in lags[row]:
            ratio = 2.0 * lag / _FINE
            ramped[:, row] = signal.lfilter([1.0, 1.0], [1.0 + ratio, 1.0 - ratio], ramped[:, row])
    return ramped


def _coloured(stream: np.random.Generator, count: int, correlation: float) -> FloatArray:
    """(count, 2) noise of deviation 1 that is correlated over so many seconds."""
    keep = np.exp(-_FINE / correlation)
    white = stream.normal(size=(count, 2)) * np.sqrt(1.0 - keep**2)
    return np.asarray(signal.lfilter([1.0], [1.0, -keep], white, axis=0))


def _poses(twist: FloatArray, every: int, latency: float) -> FloatArray:
    """(K, 3) poses of each sample as they were `latency` seconds before."""
    theta = np.cumsum(twist[:, 1]) * _FINE
    pose = np.column_stack([np.cumsum(twist[:, 0] * np.cos(theta)), np.cumsum(twist[:, 0] * np.sin(theta))]) * _FINE
    late = round(latency / _FINE)
    whole = np.column_stack([pose, theta])
    return np.concatenate([np.zeros((late, 3)), whole])[: len(whole)][::every]
