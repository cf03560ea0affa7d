"""Output-error identification of one transfer function with two poles, no zeros and a dead time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal
from scipy.optimize import least_squares

from diffdrive_mpc.models.discrete_model import DiscreteModel, zero_order_hold
from diffdrive_mpc.models.identification.fit import pooled_fit_percent
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.structures import TwoPoles

# Starting points: dead times [s] and natural frequencies [rad/s] around which a robot's drives lie.
_START_DEAD_TIMES = (0.0, 0.03, 0.08, 0.2)
_START_FREQUENCIES = (8.0, 30.0)
_LOWER = (np.log(1e-2), np.log(0.5), np.log(0.2), 0.0)
# A pole beyond about 900 rad/s cannot be seen at 50 Hz; where one is not needed, the fit would push it to infinity.
_UPPER = (np.log(1e2), np.log(150.0), np.log(3.0), 0.6)
_FEWEST_SAMPLES = 20


@dataclass(frozen=True)
class Experiment:
    """One contiguous record of one input and one output.

    The robot is settled under the first command when the record begins.

    Attributes
    ----------
    name
        For messages and provenance.
    dt
        Sample time [s].
    command, output
        (K,) each.

    Raises
    ------
    ValueError
        If the record is too short, not finite, or its command never changes.
    """

    name: str
    dt: float
    command: FloatArray
    output: FloatArray

    def __post_init__(self) -> None:
        """Check the record."""
        if self.command.shape != self.output.shape or self.command.ndim != 1:
            raise ValueError(f"experiment '{self.name}': command and output must be two rows of equal length")
        if len(self.command) < _FEWEST_SAMPLES:
            raise ValueError(
                f"experiment '{self.name}': {len(self.command)} samples; at least {_FEWEST_SAMPLES} are needed"
            )
        if not (np.isfinite(self.command).all() and np.isfinite(self.output).all()):
            raise ValueError(f"experiment '{self.name}': a sample is not finite; cut the record there")
        if np.ptp(self.command) == 0.0:
            raise ValueError(f"experiment '{self.name}': the command never changes; it excites nothing")


@dataclass(frozen=True)
class TwoPolesFit:
    """An identified transfer function.

    Attributes
    ----------
    transfer
        Gain, natural frequency and damping.
    dead_time
        [s].
    fit_percent
        Simulation FIT over all experiments [%].
    """

    transfer: TwoPoles
    dead_time: float
    fit_percent: float


def identify_two_poles(experiments: Sequence[Experiment], dead_time: float | None = None) -> TwoPolesFit:
    """Fit gain w^2 exp(-s T) / (s^2 + 2 damping w s + w^2) to all experiments at once.

    Minimises the squared difference between the measured outputs and a simulation from the commands alone (output
    error), by scipy's trust-region least squares from several starting points.

    Parameters
    ----------
    experiments
        One or more records of the same channel.
    dead_time
        T [s] where it is known; None to identify it too.

    Raises
    ------
    ValueError
        If there is no experiment, or the outputs never change.
    """
    if not experiments:
        raise ValueError("no experiments: give at least one record in which the command changes")
    measured = [experiment.output for experiment in experiments]

    def simulations(theta: FloatArray) -> list[FloatArray]:
        return [simulate_two_poles(*_unpack(theta, dead_time), experiment) for experiment in experiments]

    def residuals(theta: FloatArray) -> FloatArray:
        return np.concatenate(simulations(theta)) - np.concatenate(measured)

    free = 4 if dead_time is None else 3
    gain = _rough_gain(experiments)
    best = None
    for frequency in _START_FREQUENCIES:
        for start_dead_time in _START_DEAD_TIMES if dead_time is None else (dead_time,):
            start = np.array([np.log(gain), np.log(frequency), np.log(1.0), start_dead_time])[:free]
            start = np.clip(start, np.array(_LOWER[:free]) + 1e-6, np.array(_UPPER[:free]) - 1e-6)
            result = least_squares(
                residuals, start, bounds=(_LOWER[:free], _UPPER[:free]), x_scale=[0.1, 0.3, 0.3, 0.02][:free]
            )
            if best is None or result.cost < best.cost:
                best = result
    assert best is not None
    transfer, delay = _unpack(best.x, dead_time)
    return TwoPolesFit(transfer, delay, pooled_fit_percent(measured, simulations(best.x)))


def simulate_two_poles(transfer: TwoPoles, dead_time: float, experiment: Experiment) -> FloatArray:
    """(K,) output from the commands of `experiment` alone, settled under the first of them at the start."""
    model = _sampled(transfer, dead_time, experiment.dt)
    # Linear, so the settled start is taken off the command and added to the output.
    change = np.column_stack([experiment.command - experiment.command[0], np.zeros_like(experiment.command)])
    response = np.full(len(change), transfer.gain * experiment.command[0])
    for B, delayed in zip(
        (model.B0, model.B1), model.effective_inputs(change, np.zeros((model.memory, 2))), strict=True
    ):
        numerator, denominator = signal.ss2tf(model.A, B[:, :1], model.C[:1], np.zeros((1, 1)))
        response += signal.lfilter(numerator[0], denominator, delayed[:, 0])
    return response


def _sampled(transfer: TwoPoles, dead_time: float, dt: float) -> DiscreteModel:
    A, B, C = transfer.matrices()
    nothing = np.zeros((2, 1))
    return zero_order_hold(A, np.hstack([B, nothing]), np.vstack([C, nothing.T]), np.array([dead_time, 0.0]), dt)


def _unpack(theta: FloatArray, dead_time: float | None) -> tuple[TwoPoles, float]:
    gain, frequency, damping = np.exp(theta[:3])
    delay = float(theta[3]) if dead_time is None else dead_time
    return TwoPoles(gain=float(gain), natural_frequency=float(frequency), damping=float(damping)), delay


def _rough_gain(experiments: Sequence[Experiment]) -> float:
    """Ratio of spreads: close enough to start from."""
    command = np.concatenate([experiment.command for experiment in experiments])
    output = np.concatenate([experiment.output for experiment in experiments])
    if np.ptp(output) == 0.0:
        raise ValueError("the outputs never change: is the sensor connected, and did the robot move?")
    return float(np.std(output) / np.std(command))
