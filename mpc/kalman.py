"""The extended Kalman filter's two steps for velocity states, velocity offset and pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.discrete_model import DiscreteModel
from models.interface import FloatArray
from models.pose import linearised_arc, wrap_angle
from mpc.command_line import CommandLine
from mpc.config import Estimator


@dataclass(frozen=True, slots=True)
class Belief:
    """Mean and covariance of the filter's state: n velocity states, offset of v and omega, x, y, theta.

    The robot's twist is C x + offset; the offset is what the model does not explain, and makes tracking offset-free.
    """

    mean: FloatArray
    covariance: FloatArray


class VelocityPoseFilter:
    """Prediction and correction over one sample of a velocity model."""

    def __init__(self, model: DiscreteModel, settings: Estimator) -> None:
        n, dt = model.order, model.dt
        self._model, self._n = model, n
        self._twist = np.hstack([model.C, np.eye(2), np.zeros((2, 3))])
        self._mean_twist = np.hstack([0.5 * model.C @ (np.eye(n) + model.A), np.eye(2)])
        self._transition = np.eye(n + 5)
        self._transition[:n, :n] = model.A
        drive = model.B0 + model.B1
        noise = np.zeros((n + 5, n + 5))
        inputs = np.array([settings.v_input_noise, settings.omega_input_noise])
        noise[:n, :n] = (drive * inputs**2) @ drive.T
        self._offset_drift = [settings.v_offset_drift, settings.omega_offset_drift]
        drift = list(self._offset_drift)
        drift += [settings.position_drift, settings.position_drift, settings.heading_drift]
        noise[n:, n:] = np.diag(np.square(drift) * dt)
        self._noise = noise

    def moving(self, commands: CommandLine) -> Belief:
        """A robot that obeys the commands sent so far as the model says, somewhere.

        Its speed is as uncertain as if it might as well stand; that of a robot at rest is certain.
        """
        model, n = self._model, self._n
        _, older = commands.acting(commands.oldest)
        state = model.settled_state(older)
        for ticks_ago in range(commands.oldest, -1, -1):
            recent, older = commands.acting(ticks_ago)
            state = model.A @ state + model.B0 @ recent + model.B1 @ older
        settled = np.column_stack([model.settled_state(unit) for unit in np.eye(2)])
        P = np.zeros((n + 5, n + 5))
        P[:n, :n] = (settled * np.square(model.C @ state)) @ settled.T
        # The offset is as uncertain as a second of its drift leaves it.
        P[n : n + 2, n : n + 2] = np.diag(np.square(self._offset_drift))
        return Belief(np.concatenate([state, np.zeros(5)]), P)

    def placed(self, motion: Belief, pose: FloatArray, covariance: FloatArray) -> Belief:
        """The motion of `motion` at another `pose` (3,), known to `covariance` (3, 3)."""
        n, P = self._n, motion.covariance.copy()
        P[n + 2 :, :] = 0.0
        P[:, n + 2 :] = 0.0
        P[n + 2 :, n + 2 :] = covariance
        return Belief(np.concatenate([motion.mean[: n + 2], pose]), P)

    def twist(self, mean: FloatArray) -> FloatArray:
        """(2,) v [m/s], omega [rad/s]."""
        return self._twist @ mean

    def predict(self, belief: Belief, recent: FloatArray, older: FloatArray) -> Belief:
        """One sample ahead under the delayed commands `recent` and `older` (2,)."""
        model, n, z = self._model, self._n, belief.mean
        state = model.A @ z[:n] + model.B0 @ recent + model.B1 @ older
        offset = z[n : n + 2]
        v, omega = 0.5 * (model.C @ (z[:n] + state)) + offset
        pose, by_pose, by_twist = linearised_arc(z[n + 2 :], v, omega, model.dt)
        F = self._transition
        F[n + 2 :, : n + 2] = by_twist @ self._mean_twist
        F[n + 2 :, n + 2 :] = by_pose
        mean = np.concatenate([state, offset, pose])
        return Belief(mean, F @ belief.covariance @ F.T + self._noise)

    def correct_twist(self, belief: Belief, values: FloatArray, variances: FloatArray, rows: list[int]) -> Belief:
        """Take in v (row 0) and, or, omega (row 1)."""
        H = self._twist[rows]
        return _correct(belief, H, values - H @ belief.mean, np.diag(variances))

    def pose_at(self, belief: Belief, ahead: float) -> FloatArray:
        """(3,) the pose `ahead` seconds after the belief, at constant twist."""
        v, omega = self._twist @ belief.mean
        return linearised_arc(belief.mean[-3:], v, omega, ahead)[0]

    def correct_pose(self, belief: Belief, pose: FloatArray, covariance: FloatArray, ahead: float) -> Belief:
        """Take in a pose (3,) that was true `ahead` seconds after the belief."""
        n = self._n
        v, omega = self._twist @ belief.mean
        expected, by_pose, by_twist = linearised_arc(belief.mean[n + 2 :], v, omega, ahead)
        H = by_twist @ self._twist
        H[:, n + 2 :] = by_pose
        innovation = pose - expected
        innovation[2] = wrap_angle(innovation[2])
        return _correct(belief, H, innovation, covariance)


def _correct(belief: Belief, H: FloatArray, innovation: FloatArray, R: FloatArray) -> Belief:
    PHt = belief.covariance @ H.T
    gain = np.linalg.solve(H @ PHt + R, PHt.T).T
    P = belief.covariance - gain @ PHt.T
    return Belief(belief.mean + gain @ innovation, 0.5 * (P + P.T))
