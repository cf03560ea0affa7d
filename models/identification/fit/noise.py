"""What a drive will tell of a velocity model, before it is driven: Fisher information from the commands alone.

The information is J' J / noise^2, J the derivatives of the readings by the parameters of an SM as `identify` moves them
(Ljung, System Identification, 2nd edition, 1999, section 9.4, with white noise). What `identify` has to find beside
them, the second time constant, the gyro's bias and the state before the drive, is free here, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.parameters import Layout, ParameterEstimate, joined
from diffdrive_mpc.models.output_error.problem import OutputErrorProblem
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.validation import simulate_experiment
from diffdrive_mpc.models.structures.two_poles import TWO_POLES
from diffdrive_mpc.models.velocity_model import CHANNELS, VelocityModel

TOLD = ("gain", "lag", "dead_time")
"""Of each channel: steady-state gain [-], sum of both time constants [s], dead time [s]."""

# Of the logarithm of the second time constant, which many drives do not show: it is known to a factor of e.
_SHORT_DEVIATION = 1.0


class DriveInformation:
    """How well gain, lag and dead time of both channels will be known.

    Parameters
    ----------
    model
        What is believed of the robot. Of each channel the two poles with its gain, its mean delay and the second moment
        of its answer stand for it, so MBM and SSM will do.
    noise
        (2,) white noise of v of the encoders [m/s] and of the gyro [rad/s], a reading.
    """

    def __init__(self, model: VelocityModel, noise: ArrayLike) -> None:
        self._noise = np.asarray(noise, dtype=float)
        self._layouts, self._points = [], []
        for row, channel in enumerate(CHANNELS):
            biased = channel == "omega"
            self._layouts.append(Layout(TWO_POLES, 1, 1, offset=(biased,)))
            rest = [float(model.dead_time[row]), *([0.0] if biased else [])]
            self._points.append(np.array([*_nearest_two_poles(model, row), *rest]))

    def parameters(self, commands: FloatArray, dt: float) -> ParameterEstimate:
        """`TOLD` of v and of omega, and their covariance (6, 6), from commands (K, 2) sent every `dt` [s] from rest.

        Raises
        ------
        ValueError
            If a command is not finite, or there are too few.
        """
        return joined([self._channel(row, commands[:, [row]], dt).renamed(name) for row, name in enumerate(CHANNELS)])

    def log_determinant(self, commands: FloatArray, dt: float) -> float:
        """Of the information on `TOLD`, of both channels: the more, the more a drive tells (D-optimality).

        Its size depends on units; the difference between two drives does not.
        """
        sign, logarithm = np.linalg.slogdet(self.parameters(commands, dt).covariance)
        return -float(logarithm) if sign > 0 else -np.inf

    def _channel(self, row: int, commands: FloatArray, dt: float) -> ParameterEstimate:
        layout, point = self._layouts[row], self._points[row]
        unknown = SampledExperiment(
            "drive", dt, commands, np.zeros(commands.shape), np.ones(commands.shape, dtype=bool)
        )
        outputs = simulate_experiment(layout.system(point), unknown)
        drive = SampledExperiment("drive", dt, commands, outputs, unknown.counts)
        slopes = OutputErrorProblem(layout, [drive], [np.full(outputs.shape, 1 / self._noise[row])]).jacobian(point)
        information = slopes.T @ slopes
        information[2, 2] += _SHORT_DEVIATION**-2
        # A channel that never moves tells nothing: as little as rounding keeps it invertible.
        scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny ** 0.25))
        inverse = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
        estimate = ParameterEstimate(layout.names, point, inverse)
        return estimate.derived(TOLD, lambda values: np.array([np.exp(values[0]), np.exp(values[1]), values[3]]))


def _nearest_two_poles(model: VelocityModel, row: int) -> FloatArray:
    """(3,) logarithms of gain, lag and short of gain / (1 + lag s + lag short s^2), from the moments of a channel.

    G(s) / G(0) = 1 - lag s + (lag^2 - lag short) s^2 - ..., and G(s) = C (s - A)^-1 B = -sum C A^-(k+1) B s^k.
    """
    settled = np.linalg.solve(model.A, model.B[:, row])
    once = np.linalg.solve(model.A, settled)
    gain, first, second = -(model.C[row] @ np.column_stack([settled, once, np.linalg.solve(model.A, once)]))
    lag = -first / gain
    short = lag - second / gain / lag if lag > 0 else 0.0
    settings = estimator_settings()
    bounds = np.array([settings.gain, settings.lag, settings.short]).T
    return np.asarray(np.log(np.clip([gain, lag, short], *bounds)))


# How far the readings of a log scatter from one to the next.


# Nine tenths of normal values are within so many standard deviations. Plateaus of counted pulses make the median zero.
_SHARE, _WITHIN = 0.9, 1.645
# Standard deviation of x[k-1] - 2 x[k] + x[k+1] over that of x: what changes evenly has no part in it.
_SECOND_DIFFERENCE = np.sqrt(6.0)
_FEWEST = 50


def sensor_noise(records: Sequence[Record]) -> dict[str, float]:
    """Standard deviation of what is random in the readings, by the name of its key in the group `estimator`.

    From second differences of neighbouring readings, so outliers and steady motion do not count. Sensors without enough
    readings have no entry. Units: m/s, rad/s, m, rad.
    """
    sources = {
        "wheel_speed_noise": ("twist", [0]),
        "wheel_yaw_rate_noise": ("twist", [1]),
        "yaw_rate_noise": ("yaw_rate", [0]),
        "position_noise": ("pose", [0, 1]),
        "heading_noise": ("pose", [2]),
    }
    joined = {
        name: np.concatenate([_scatter(record, signal, columns) for record in records])
        for name, (signal, columns) in sources.items()
    }
    return {
        name: float(np.quantile(np.abs(second), _SHARE) / (_WITHIN * _SECOND_DIFFERENCE))
        for name, second in joined.items()
        if second.size >= _FEWEST
    }


def scatter_by_block(records: Sequence[Record], signal: str, column: int) -> FloatArray:
    """(B,) variance of what is random in one column of a signal, in each block of the settings' length.

    Each block counts the second differences of its readings; blocks with fewer than fifty are left out.
    """
    variances = []
    for record in records:
        span = max(1, round(identification_settings().block_time / record.dt))
        for first in range(0, len(record.command), span):
            second = _scatter(record.part(first, min(first + span, len(record.command))), signal, [column])
            if second.size >= _FEWEST:
                variances.append(float(np.mean(second**2)) / _SECOND_DIFFERENCE**2)
    return np.array(variances)


def _scatter(record: Record, signal: str, columns: list[int]) -> FloatArray:
    """Second differences of readings that are equally far apart."""
    fresh = record.fresh(signal)
    if fresh is None:
        return np.empty(0)
    (at,) = np.nonzero(fresh)
    even = np.diff(at[:-1]) == np.diff(at[1:])
    return np.asarray(
        np.diff(getattr(record, signal).reshape(len(fresh), -1)[at][:, columns], n=2, axis=0)[even].ravel()
    )
