"""The extended Kalman filter's two steps for velocity states, slip, gyro bias and pose.

The state is z = (x, v_offset, omega_gain, longitudinal_gain, yaw_gain, side_slip, gyro_bias, pose): the n states of the
velocity model, what lies between the model's twist and the true one (see `mpc.slip`), the gyro's bias [rad/s] and
x, y [m], theta [rad].
"""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import linearised_arc, wrap_angle
from diffdrive_mpc.mpc.belief import Belief
from diffdrive_mpc.mpc.command_line import CommandLine
from diffdrive_mpc.mpc.config.schema import Compensation, Estimator
from diffdrive_mpc.mpc.slip import Slip

# Places after the n velocity states.
_V_OFFSET, _OMEGA_GAIN, _LONGITUDINAL_GAIN, _YAW_GAIN, _SIDE_SLIP, _GYRO_BIAS, _POSE = range(7)
# Places in the counts of surprises.
_WHEEL_SPEED, _WHEEL_YAW_RATE, _YAW_RATE, _POSES = range(4)


class SlipFilter:
    """Prediction and correction over one sample of a velocity model.

    Parameters
    ----------
    model
        The sampled velocity model.
    settings
        Noise that is assumed, and limits of what is believed.
    compensation
        What is estimated at all; the rest keeps the value of a robot without slip.
    wheel_yaw_ratio
        Yaw rate by encoders and geometric track over that of the model, where omega_gain is 1.
    """

    def __init__(
        self, model: DiscreteModel, settings: Estimator, compensation: Compensation, wheel_yaw_ratio: float
    ) -> None:
        n, dt = model.order, model.dt
        self._model, self._settings, self._n, self.wheel_yaw_ratio = model, settings, n, wheel_yaw_ratio
        self.mean_output = 0.5 * model.C @ (np.eye(n) + model.A)
        self.settled = np.column_stack([model.settled_state(unit) for unit in np.eye(2)])
        self._transition = np.eye(n + 9)
        self._transition[:n, :n] = model.A
        on, s = compensation, settings
        estimated = np.array([on.v_offset, on.yaw_gain, on.v_offset, on.yaw_gain, on.side_slip, True])
        uncertainty = [
            s.v_offset_uncertainty,
            s.omega_gain_uncertainty,
            s.longitudinal_gain_uncertainty,
            s.yaw_gain_uncertainty,
            s.side_slip_uncertainty,
            s.gyro_bias_uncertainty,
        ]
        drift = [
            s.v_offset_drift,
            s.omega_gain_drift,
            s.longitudinal_gain_drift,
            s.yaw_gain_drift,
            s.side_slip_drift,
            s.gyro_bias_drift,
        ]
        self.uncertainty = estimated * np.array(uncertainty)
        self.drift = dt * np.square(estimated * np.array(drift))
        drive = model.B0 + model.B1
        noise = np.zeros((n + 9, n + 9))
        inputs = np.array([s.v_input_noise, s.omega_input_noise])
        noise[:n, :n] = (drive * inputs**2) @ drive.T
        pose = np.square([s.position_drift, s.position_drift, s.heading_drift])
        noise[n + _POSE :, n + _POSE :] = np.diag(pose * dt)
        self.noise = noise
        self._diagonal = np.arange(n, n + _POSE)
        self.patience = round(s.lasting_surprise / dt)

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
        P = np.zeros((n + 9, n + 9))
        P[:n, :n] = (self.settled * np.square(model.C @ state)) @ self.settled.T
        P[self._diagonal, self._diagonal] = np.square(self.uncertainty)
        mean = np.zeros(n + 9)
        mean[:n] = state
        mean[n + _OMEGA_GAIN : n + _SIDE_SLIP] = 1.0
        return Belief(mean, P)

    def placed(self, motion: Belief, pose: FloatArray, covariance: FloatArray) -> Belief:
        """The motion of `motion` at another `pose` (3,), known to `covariance` (3, 3)."""
        at, P, mean = self._n + _POSE, motion.covariance.copy(), motion.mean.copy()
        P[at:, :] = 0.0
        P[:, at:] = 0.0
        P[at:, at:] = covariance
        mean[at:] = pose
        return Belief(mean, P)

    def slip(self, mean: FloatArray) -> Slip:
        """The slip in a state (n + 9,), or of its standard deviations."""
        return Slip(*mean[self._n : self._n + _GYRO_BIAS].tolist())

    def twist(self, mean: FloatArray) -> FloatArray:
        """(2,) v [m/s], omega [rad/s] of the body."""
        v, omega, _, _ = self._twist(mean, self._model.C @ mean[: self._n])
        return np.array([v, omega])

    def twist_deviation(self, belief: Belief) -> FloatArray:
        """(2,) standard deviations of v [m/s] and omega [rad/s]."""
        T = self._twist_gradient(belief.mean, self._model.C)
        return np.asarray(np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", T, belief.covariance, T), 0.0)))

    def predict(self, belief: Belief, recent: FloatArray, older: FloatArray) -> Belief:
        """One sample ahead under the delayed commands `recent` and `older` (2,)."""
        model, n, z, s = self._model, self._n, belief.mean, self._settings
        at = n + _POSE
        state = model.A @ z[:n] + model.B0 @ recent + model.B1 @ older
        output = 0.5 * model.C @ (z[:n] + state)
        v, omega, _, _ = self._twist(z, output)
        pose, by_pose, by_twist = linearised_arc(z[at:], v, omega, model.dt, z[n + _SIDE_SLIP])
        F = self._transition
        T = self._twist_gradient(z, self.mean_output, output)
        F[at:, :at] = by_twist[:, :2] @ T[:, :at]
        F[at:, n + _SIDE_SLIP] += by_twist[:, 2]
        F[at:, at:] = by_pose
        P = F @ belief.covariance @ F.T + self.noise
        # A gain shows only while its channel moves: without news its uncertainty must not grow.
        turning, driving = abs(omega) >= s.least_yaw_rate, abs(v) >= s.least_speed
        moving = np.array([True, turning, driving, turning, turning and driving, True])
        P[self._diagonal, self._diagonal] += self.drift * moving
        mean = z.copy()
        mean[:n], mean[at:] = state, pose
        return belief.later(mean, P)

    def correct_wheel_speed(self, belief: Belief, value: float, variance: float) -> tuple[Belief, float]:
        """Take in the forward speed of the wheels [m/s]; returns the normalised innovation too."""
        n = self._n
        h = np.zeros(n + 9)
        h[:n] = self._model.C[0]
        h[n + _V_OFFSET] = 1.0
        return self._correct_scalar(belief, _WHEEL_SPEED, h, value - float(h @ belief.mean), variance)

    def correct_wheel_yaw_rate(self, belief: Belief, value: float, variance: float) -> tuple[Belief, float]:
        """Take in the yaw rate by encoders and geometric track [rad/s], which tells of the wheels, not of the body."""
        n, z = self._n, belief.mean
        output, gain = float(self._model.C[1] @ z[:n]), float(z[n + _OMEGA_GAIN])
        h = np.zeros(n + 9)
        h[:n] = self.wheel_yaw_ratio * gain * self._model.C[1]
        h[n + _OMEGA_GAIN] = self.wheel_yaw_ratio * output
        return self._correct_scalar(belief, _WHEEL_YAW_RATE, h, value - self.wheel_yaw_ratio * gain * output, variance)

    def correct_yaw_rate(self, belief: Belief, value: float, variance: float) -> tuple[Belief, float]:
        """Take in the gyro's yaw rate [rad/s]: the body's, and a bias."""
        n, z = self._n, belief.mean
        h = self._twist_gradient(z, self._model.C)[1]
        h[n + _GYRO_BIAS] = 1.0
        innovation = value - float(self.twist(z)[1] + z[n + _GYRO_BIAS])
        return self._correct_scalar(belief, _YAW_RATE, h, innovation, variance)

    def pose_at(self, belief: Belief, ahead: float) -> FloatArray:
        """(3,) the pose `ahead` seconds after the belief, at constant twist."""
        v, omega = self.twist(belief.mean)
        return linearised_arc(belief.mean[-3:], v, omega, ahead, belief.mean[self._n + _SIDE_SLIP])[0]

    def correct_pose(
        self, belief: Belief, pose: FloatArray, covariance: FloatArray, ahead: float
    ) -> tuple[Belief, float]:
        """Take in a pose (3,) that was true `ahead` seconds after the belief; returns the normalised innovation too.

        A pose that the belief cannot explain says that something moved the robot: then the pose is believed, and
        nothing is learned from it about slip, unless that goes on.
        """
        n, z, P = self._n, belief.mean, belief.covariance
        at = n + _POSE
        v, omega = self.twist(z)
        expected, by_pose, by_twist = linearised_arc(z[at:], v, omega, ahead, z[n + _SIDE_SLIP])
        H = by_twist[:, :2] @ self._twist_gradient(z, self._model.C)
        H[:, n + _SIDE_SLIP] += by_twist[:, 2]
        H[:, at:] = by_pose
        innovation = pose - expected
        innovation[2] = wrap_angle(innovation[2])
        PHt = P @ H.T
        S = H @ PHt + covariance
        normalised = float(innovation @ np.linalg.solve(S, innovation)) / 3
        belief, pushed = self._judged(belief, _POSES, normalised)
        if pushed:
            P = P.copy()
            P[at:, at:] += np.diag(np.square(innovation))
            PHt = P @ H.T
            S = H @ PHt + covariance
        gain = np.asarray(np.linalg.solve(S, PHt.T).T, dtype=float)
        gain[self._frozen(z, pushed)] = 0.0
        return belief.corrected(self._bounded(z + gain @ innovation), P, gain, PHt, S), normalised

    def _twist(self, z: FloatArray, output: FloatArray) -> tuple[float, float, float, float]:
        """Forward speed and yaw rate of the body for the model's `output` (2,), v of the wheels, gain of omega."""
        v_offset, omega_gain, longitudinal_gain, yaw_gain = z[self._n : self._n + _SIDE_SLIP].tolist()
        wheels, gain = float(output[0]) + v_offset, omega_gain * yaw_gain
        return longitudinal_gain * wheels, gain * float(output[1]), wheels, gain

    def _twist_gradient(self, z: FloatArray, C: FloatArray, output: FloatArray | None = None) -> FloatArray:
        """(2, n + 9) gradient of the body's twist for an output `C` x."""
        n = self._n
        output = C @ z[:n] if output is None else output
        _, _, wheels, gain = self._twist(z, output)
        T = np.zeros((2, n + 9))
        T[0, :n], T[1, :n] = z[n + _LONGITUDINAL_GAIN] * C[0], gain * C[1]
        T[0, n + _V_OFFSET], T[0, n + _LONGITUDINAL_GAIN] = z[n + _LONGITUDINAL_GAIN], wheels
        T[1, n + _OMEGA_GAIN], T[1, n + _YAW_GAIN] = z[n + _YAW_GAIN] * output[1], z[n + _OMEGA_GAIN] * output[1]
        return T

    def _correct_scalar(
        self, belief: Belief, sensor: int, h: FloatArray, innovation: float, variance: float
    ) -> tuple[Belief, float]:
        """Correct with gradient `h` (n + 9,) of what `sensor` measures."""
        n, P = self._n, belief.covariance
        PHt = P @ h
        normalised = innovation * innovation / (float(h @ PHt) + variance)
        belief, pushed = self._judged(belief, sensor, normalised)
        if pushed:
            settled = self.settled[:, 0 if sensor == _WHEEL_SPEED else 1]
            P = P.copy()
            P[:n, :n] += innovation**2 * np.outer(settled, settled)
            PHt = P @ h
        S = float(h @ PHt) + variance
        gain = PHt / S
        gain[self._frozen(belief.mean, pushed)] = 0.0
        mean = self._bounded(belief.mean + gain * innovation)
        return belief.corrected(mean, P, gain[:, None], PHt[:, None], np.array([[S]])), normalised

    def _judged(self, belief: Belief, sensor: int, normalised: float) -> tuple[Belief, bool]:
        """Count an innovation; whether it tells of something other than slip, which does not last."""
        surprising = normalised > self._settings.surprise
        belief = belief.judged(sensor, surprising)
        return belief, surprising and belief.surprised[sensor] <= self.patience

    def _frozen(self, z: FloatArray, pushed: bool) -> list[int]:
        """Places of the states that a measurement may not change."""
        n = self._n
        if pushed:
            # The robot does not do as told, for a reason that is none of slip: velocity and pose take it all.
            return list(range(n, n + _POSE))
        if abs(self.twist(z)[1]) < self._settings.least_yaw_rate:
            return [n + _OMEGA_GAIN, n + _YAW_GAIN]
        return []

    def _bounded(self, z: FloatArray) -> FloatArray:
        """`z` with gains that a robot can have: commands are divided by them."""
        gains = slice(self._n + _OMEGA_GAIN, self._n + _SIDE_SLIP)
        z[gains] = np.minimum(np.maximum(z[gains], self._settings.least_gain), self._settings.most_gain)
        return z
