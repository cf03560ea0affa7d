"""Expected Fisher information of a drive about a velocity model, from the commands only.

The information is J' J / noise^2. J are the derivatives of the readings with respect to the parameters of an SM, as in
`identify` (Ljung, System Identification, 2nd edition, 1999, section 9.4, with white noise). The other unknowns of
`identify` are free as well: the second time constant, the gyro bias and the state before the drive.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.parameters import Layout, ParameterEstimate, join_estimates
from diffdrive_mpc.models.output_error.problem import OutputErrorProblem
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.validation import simulate_experiment
from diffdrive_mpc.models.structures.two_poles import TWO_POLES
from diffdrive_mpc.models.velocity_model import CHANNELS, VelocityModel

REPORTED = ("gain", "lag", "dead_time")
"""Parameters of each channel: steady-state gain [-], sum of both time constants [s], dead time [s]."""

# Prior standard deviation of the logarithm of the second time constant, which many drives do not determine.
_SHORT_DEVIATION = 1.0


class DriveInformation:
    """Predicted covariance of gain, lag and dead time of both channels.

    Parameters
    ----------
    model
        Model of the robot, of any linear structure. Each channel is replaced by two poles with the same gain, mean
        delay and second moment of the impulse response.
    noise
        (2,) standard deviation of the white noise of one reading: v from the encoders [m/s] and gyro [rad/s].
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
        """Return the parameters `REPORTED` of both channels with covariance (6, 6), for commands (K, 2) every `dt` [s].

        The drive starts at rest.

        Raises
        ------
        ValueError
            If a command is not finite, or there are too few commands.
        """
        return join_estimates(
            [self._channel(row, commands[:, [row]], dt).renamed(name) for row, name in enumerate(CHANNELS)]
        )

    def log_determinant(self, commands: FloatArray, dt: float) -> float:
        """Return the log-determinant of the information on `REPORTED`, the criterion of D-optimality.

        The value depends on the units; the difference between two drives does not.
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
        # The information of a channel at rest is zero: a value at rounding level keeps the matrix invertible.
        scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny ** 0.25))
        inverse = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
        estimate = ParameterEstimate(layout.names, point, inverse)
        return estimate.derived(REPORTED, lambda values: np.array([np.exp(values[0]), np.exp(values[1]), values[3]]))


def _nearest_two_poles(model: VelocityModel, row: int) -> FloatArray:
    """Return (3,) logarithms of gain, lag and short of gain / (1 + lag s + lag short s^2) with a channel's moments.

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
