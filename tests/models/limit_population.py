"""Random robots whose command is clipped at a known level, or that have another defect."""

import numpy as np
from scipy import signal

from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.velocity_model import CHANNELS

_LIMIT_FRACTIONS = (0.6, 0.9)
_DEFECTS = ("nothing", "slew", "compressed gain", "dead band", "sagging gain", "gain of the other channel")


def drawn_record(seed: int) -> Record:
    """Simulate a random robot with two lags, a dead time and at most one limit of its commands.

    Its speeds deviate from that model by correlated noise; without a limit the robot has another defect.
    """
    rng = np.random.default_rng(seed)
    dt, count = 0.05, int(rng.integers(1500, 5000))
    command = np.column_stack([_drive(rng, dt, count) for _ in CHANNELS]) * rng.uniform([0.4, 0.6], [4.0, 3.0])
    row = int(rng.integers(2))
    is_limited = rng.random() < 0.5
    defect = "nothing" if is_limited else str(rng.choice(_DEFECTS))
    applied = command.copy()
    if is_limited:
        level = rng.uniform(*_LIMIT_FRACTIONS) * np.quantile(np.abs(command[:, row]), 0.995)
        applied[:, row] = np.clip(applied[:, row], -level, level)
    max_command = np.abs(command).max(axis=0)
    if defect == "compressed gain":
        applied = max_command * np.tanh(0.5 * applied / max_command) / 0.5
    elif defect == "dead band":
        applied = np.sign(applied) * np.maximum(np.abs(applied) - 0.08 * max_command, 0.0)
    elif defect == "sagging gain":
        applied *= np.linspace(1.0, 0.85, count)[:, None]
    elif defect == "gain of the other channel":
        applied *= 1.0 - 0.2 * np.abs(command[:, ::-1]) / max_command[::-1]
    elif defect == "slew":
        applied = _limit_slew(applied, rng.uniform(0.5, 2.0) * max_command * dt)
    speeds = np.column_stack([_channel_response(rng, column, dt) for column in applied.T])
    decay = np.exp(-dt / rng.uniform(0.1, 1.0))
    white = rng.normal(size=(count, 2)) * np.sqrt(1 - decay**2)
    speeds += rng.uniform(0.01, 0.15) * speeds.std(axis=0) * signal.lfilter([1.0], [1.0, -decay], white, axis=0)
    speeds += 0.01 * speeds.std(axis=0) * rng.normal(size=(count, 2))
    return Record(f"robot {seed}", 0.0, dt, command, twist=speeds, yaw_rate=speeds[:, 1].copy())


def _drive(rng, dt, count):
    """Draw commands (K,) between -1 and 1 of one of three kinds: steps, steps with ramps, sums of sines."""
    kind, time = rng.integers(3), dt * np.arange(count)
    if kind == 2:
        rates, phases = rng.uniform(0.1, 1.5, 4), rng.uniform(0, 2 * np.pi, 4)
        return np.sin(np.outer(time, rates) + phases).mean(axis=1)
    hold = round(rng.uniform(0.7, 4.0) / dt)
    levels = rng.uniform(-1, 1, count // hold + 2) * rng.random(count // hold + 2) ** rng.uniform(0.0, 1.0)
    steps = np.repeat(levels, hold)[:count]
    width = 1 if kind == 0 else max(1, hold // 2)
    return signal.lfilter(np.full(width, 1 / width), [1.0], steps)


def _channel_response(rng, applied, dt):
    """Simulate the speeds (K,) of a random channel."""
    delay, decay = int(rng.integers(0, 5)), np.exp(-dt / rng.uniform(0.03, 0.4))
    delayed = np.concatenate([np.zeros(delay + 1), applied])[: len(applied)]
    for part in (decay, decay ** rng.uniform(1.0, 5.0)):
        delayed = signal.lfilter([1 - part], [1.0, -part], delayed)
    return rng.uniform(0.6, 1.1) * delayed


def _limit_slew(values, max_step):
    result = values.copy()
    for k in range(1, len(result)):
        result[k] = result[k - 1] + np.clip(values[k] - result[k - 1], -max_step, max_step)
    return result
