"""The least that an identification has to beat: a second-order lag with dead time for each channel, fitted plainly."""

import numpy as np
from scipy import signal
from scipy.optimize import least_squares

_STARTS = [(gain, lag, dead_time) for gain in (0.5, 1.0) for lag in (0.1, 0.3, 1.0) for dead_time in (0.02, 0.2)]


def response(parameters, command, first, dt):
    """(K,) from the command (K,) alone, settled at the `first` reading; gain, two lags [s], dead time [s], offset."""
    gain, slow, fast, dead_time, offset = parameters
    late = int(dead_time / dt)
    rest = dead_time / dt - late
    line = np.concatenate([np.full(late + 1, (first - offset) / gain), command])
    drive = (1 - rest) * line[1 : len(command) + 1] + rest * line[: len(command)] - line[0]
    for lag in (slow, fast):
        keep = np.exp(-dt / lag)
        drive = signal.lfilter([0.0, 1.0 - keep], [1.0, -keep], drive)
    return gain * (drive + line[0]) + offset


def fit_second_order(commands, readings, fresh, dt):
    """(5,) parameters from lists of stretches of one channel: commands, readings and which of these count."""
    firsts = [y[np.argmax(f)] for y, f in zip(readings, fresh, strict=True)]

    def errors(parameters):
        runs = zip(commands, readings, fresh, firsts, strict=True)
        return np.concatenate([(y - response(parameters, u, first, dt))[f] for u, y, f, first in runs])

    bounds = ([0.05, 0.01, 0.005, 0.0, -0.3], [5.0, 4.0, 2.0, 0.6, 0.3])
    starts = sorted(
        ([g, lag, 0.3 * lag, d, 0.0] for g, lag, d in _STARTS), key=lambda start: np.sum(errors(start) ** 2)
    )
    fits = [least_squares(errors, start, bounds=bounds, x_scale=[1, 0.1, 0.1, 0.1, 0.1]) for start in starts[:2]]
    return min(fits, key=lambda fit: fit.cost).x
