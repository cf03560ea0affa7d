"""Estimator of all peers: the estimate of the predictive controller, predicted over the delay of the robot.

A command takes effect after a delay, so feedback of the current pose would be outdated. The velocity model predicts the
effect of the commands that have already been sent.
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
    """Estimator of the predictive controller: its compiled tick on hold, which estimates but does not solve.

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
        """Velocity model with the extra dead time of the configuration."""
        model = self._controller.model
        assert isinstance(model, VelocityModel)
        return model

    def start(self, reference: Reference, t0: float) -> None:
        """Restart with `reference`, whose time 0 is `t0` [s]; raise the errors of `Controller.start`."""
        self._controller.start(reference, t0)

    def step(self, t: float, measurement: Measurement) -> Estimate | None:
        """Compute the estimate for the tick at `t` [s] from the new measurements; return None before the first pose."""
        if measurement.sent is None and self._sent is not None:
            measurement = replace(measurement, sent=self._sent)
        return self._controller.step(t, measurement, _HOLD).estimate

    def record_command(self, command: FloatArray) -> None:
        """Store the command (2,) of this tick; otherwise the controller on hold assumes its own braking command."""
        self._sent = (float(command[0]), float(command[1]))


class PredictedMotion(NamedTuple):
    """Predicted pose and twist of the robot."""

    pose: FloatArray
    """(3,) x [m], y [m], theta [rad, unwrapped]."""
    twist: FloatArray
    """(2,) v [m/s], omega [rad/s] of the body, including slip."""


class DelayPredictor:
    """Prediction of an estimate from the past commands; the last command is held until the end of the prediction.

    Parameters
    ----------
    model
        Velocity model.
    dt
        Sample time [s].
    lead
        Prediction time [s], not necessarily a multiple of `dt`.
    """

    def __init__(self, model: VelocityModel, dt: float, lead: float) -> None:
        sampled = model.discretise(dt)
        self._memory = sampled.memory
        self._twist, self._move, self._sample_time = formula("twist"), formula("move"), dt
        full_samples = int(np.floor(lead / dt + 1e-9))
        self._durations = np.append(np.full(full_samples, dt), max(0.0, lead - full_samples * dt))
        self._share = self._durations[-1] / dt
        # The outputs are linear in state and commands, so the responses to unit vectors are the columns of the matrix.
        ticks, n = full_samples + 2, sampled.order
        units = np.eye(2 * self._memory).reshape(-1, self._memory, 2)
        state_responses = [sampled.simulate(np.zeros((ticks, 2)), state=unit).ravel() for unit in np.eye(n)]
        command_responses = [sampled.simulate(np.tile(unit[-1], (ticks, 1)), past=unit).ravel() for unit in units]
        self._outputs = np.column_stack(state_responses + command_responses)
        self._past = np.zeros((self._memory, 2))

    def reset(self) -> None:
        """Set all past commands to zero, because the robot starts at rest."""
        self._past[:] = 0.0

    def record_command(self, command: FloatArray) -> None:
        """Store the command (2,) of this tick."""
        self._past = np.vstack([self._past[1:], command])

    def predict(self, pose: FloatArray, state: FloatArray, slip: Slip) -> PredictedMotion:
        """Predict the motion at the end of the prediction time.

        Parameters
        ----------
        pose, state
            Current pose (3,) and state (n,) of the velocity model.
        slip
            Slip between the twist of the model and that of the body.
        """
        outputs = (self._outputs @ np.concatenate([state, self._past.ravel()])).reshape(-1, 2)
        slip_values = slip.flat
        twists = np.array(self._twist(outputs.T, slip_values)[0]).T
        acceleration = np.diff(twists[:, 0]) / self._sample_time
        theta = pose[2] + np.concatenate([[0.0], np.cumsum(0.5 * (twists[:-1, 1] + twists[1:, 1]) * self._durations)])
        middle = 0.5 * (outputs[:-1] + outputs[1:])
        rows = (values[None] for values in (theta[:-1], acceleration, self._durations))
        displacement = np.array(self._move(middle.T, slip_values, *rows)[0]).sum(axis=1)
        return PredictedMotion(pose + displacement, (1 - self._share) * twists[-2] + self._share * twists[-1])
