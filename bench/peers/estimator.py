"""Estimator of every peer: the predictive controller's estimate, predicted over the robot's delay.

A command takes effect one lag later, so a law that acts on the present pose acts too late. The commands already sent
are known, and the velocity model predicts their effect.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import Controller, ControllerConfig
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.problem.formulas import formula
from diffdrive_mpc.mpc.problem.slip import Slip

_HOLD = Hold("it only estimates")


class HeldEstimator:
    """The estimator of the predictive controller: the same compiled tick, held so that it does not solve.

    Parameters
    ----------
    config
        Configuration of the estimator and the velocity model.
    """

    def __init__(self, config: ControllerConfig) -> None:
        self._controller = Controller(config)
        self._sent: tuple[float, float] | None = None

    @property
    def model(self) -> VelocityModel:
        """The velocity model, extra dead time included."""
        model = self._controller.model
        assert isinstance(model, VelocityModel)
        return model

    def start(self, reference: Reference, t0: float) -> None:
        """Restart with `reference` and `t0` [s] as `Controller.start` checks them."""
        self._controller.start(reference, t0)

    def step(self, t: float, measurement: Measurement) -> Estimate | None:
        """Compute the estimate at the tick at `t` [s] from the new measurements; None before the first pose."""
        if measurement.sent is None and self._sent is not None:
            measurement = replace(measurement, sent=self._sent)
        return self._controller.step(t, measurement, _HOLD).estimate

    def sent(self, command: FloatArray) -> None:
        """Store the command (2,) of this tick; the held controller would otherwise assume that it brakes."""
        self._sent = (float(command[0]), float(command[1]))


class PredictedMotion(NamedTuple):
    """Predicted pose and motion of the robot."""

    pose: FloatArray
    """(3,) x [m], y [m], theta [rad, unwrapped]."""
    twist: FloatArray
    """(2,) v [m/s], omega [rad/s] of the body, slip included."""


class DelayPredictor:
    """Predictor of an estimate over the commands already sent; the last one is held.

    Parameters
    ----------
    model
        The velocity model, dead time included.
    dt
        Sample time [s].
    lead
        Prediction time [s]; it need not be a multiple of `dt`.
    """

    def __init__(self, model: VelocityModel, dt: float, lead: float) -> None:
        sampled = model.discretise(dt)
        self._memory = sampled.memory
        self._twist, self._move, self._sample_time = formula("twist"), formula("move"), dt
        whole = int(np.floor(lead / dt + 1e-9))
        self._durations = np.append(np.full(whole, dt), max(0.0, lead - whole * dt))
        self._share = self._durations[-1] / dt
        # The outputs are linear in state and commands: the outputs of unit vectors are the columns of the matrix.
        ticks, n = whole + 2, sampled.order
        units = np.eye(2 * self._memory).reshape(-1, self._memory, 2)
        states = [sampled.simulate(np.zeros((ticks, 2)), state=unit).ravel() for unit in np.eye(n)]
        pasts = [sampled.simulate(np.tile(unit[-1], (ticks, 1)), past=unit).ravel() for unit in units]
        self._outputs = np.column_stack(states + pasts)
        self._past = np.zeros((self._memory, 2))

    def reset(self) -> None:
        """Forget the commands, for a robot at rest."""
        self._past[:] = 0.0

    def sent(self, command: FloatArray) -> None:
        """Enter the command (2,) of this tick."""
        self._past = np.vstack([self._past[1:], command])

    def predict(self, pose: FloatArray, state: FloatArray, slip: Slip) -> PredictedMotion:
        """Predict the motion one lead later.

        Parameters
        ----------
        pose, state
            (3,) pose and (n,) states of the velocity model now.
        slip
            Slip between the model's twist and the body's.
        """
        outputs = (self._outputs @ np.concatenate([state, self._past.ravel()])).reshape(-1, 2)
        slips = slip.flat
        twists = np.array(self._twist(outputs.T, slips)[0]).T
        acceleration = np.diff(twists[:, 0]) / self._sample_time
        theta = pose[2] + np.concatenate([[0.0], np.cumsum(0.5 * (twists[:-1, 1] + twists[1:, 1]) * self._durations)])
        middle = 0.5 * (outputs[:-1] + outputs[1:])
        rows = (values[None] for values in (theta[:-1], acceleration, self._durations))
        moved = np.array(self._move(middle.T, slips, *rows)[0]).sum(axis=1)
        return PredictedMotion(pose + moved, (1 - self._share) * twists[-2] + self._share * twists[-1])
