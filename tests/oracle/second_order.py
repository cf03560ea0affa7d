"""Baseline for an identification: a second-order lag with dead time for each channel, fitted by least squares.

With `clip`, a limit of the command is fitted as well.
"""

import numpy as np
from scipy import signal
from scipy.optimize import least_squares

_STARTS = [(gain, lag, dead_time) for gain in (0.5, 1.0) for lag in (0.1, 0.3, 1.0) for dead_time in (0.02, 0.2)]
_LEVELS = np.linspace(0.4, 0.95, 12)


def response(parameters, command, first, dt):
    """Simulate the output (K,) from the command (K,), starting at rest at the `first` reading.

    Parameters are gain, two lags [s], dead time [s], offset and, optionally, the limit of the command.
    """
    gain, slow, fast, dead_time, offset, *limit = parameters
    for level in limit:
        command = np.clip(command, -level, level)
    steps = int(dead_time / dt)
    fraction = dead_time / dt - steps
    delay_line = np.concatenate([np.full(steps + 1, (first - offset) / gain), command])
    drive = (1 - fraction) * delay_line[1 : len(command) + 1] + fraction * delay_line[: len(command)] - delay_line[0]
    for lag in (slow, fast):
        decay = np.exp(-dt / lag)
        drive = signal.lfilter([0.0, 1.0 - decay], [1.0, -decay], drive)
    return gain * (drive + delay_line[0]) + offset


def fit_second_order(commands, readings, valid, dt, clip=False):
    """Fit parameters (5,), or (6,) with `clip`, to lists of commands, readings and their validity of one channel."""
    firsts = [y[np.argmax(f)] for y, f in zip(readings, valid, strict=True)]

    def errors(parameters):
        runs = zip(commands, readings, valid, firsts, strict=True)
        return np.concatenate([(y - response(parameters, u, first, dt))[f] for u, y, f, first in runs])

    bounds = ([0.05, 0.01, 0.005, 0.0, -0.3], [5.0, 4.0, 2.0, 0.6, 0.3])
    starts = sorted(
        ([g, lag, 0.3 * lag, d, 0.0] for g, lag, d in _STARTS), key=lambda start: np.sum(errors(start) ** 2)
    )
    fits = [least_squares(errors, start, bounds=bounds, x_scale=[1, 0.1, 0.1, 0.1, 0.1]) for start in starts[:2]]
    best = min(fits, key=lambda fit: fit.cost).x
    if not clip:
        return best
    max_command = max(np.abs(u).max() for u in commands)
    starts = sorted(([*best, level * max_command] for level in _LEVELS), key=lambda start: np.sum(errors(start) ** 2))
    bounds = [[*bound, level] for bound, level in zip(bounds, (0.2 * max_command, max_command), strict=True)]
    fits = [least_squares(errors, start, bounds=bounds, x_scale=[1, 0.1, 0.1, 0.1, 0.1, 0.1]) for start in starts[:2]]
    return min(fits, key=lambda fit: fit.cost).x
