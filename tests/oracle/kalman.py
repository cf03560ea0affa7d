"""The extended Kalman filter: z = (x, slip, gyro_bias, delays, pose).

x are the n states of the velocity model; then the ten slip parameters of `mpc.problem.slip`, between its twist and that
of the body, the bias of the gyro [rad/s], the delays of v and omega that the model lacks [s], and x, y [m], theta
[rad]. Functions of z take one state (n + 16,) or several columns. `acting` (m, 2) are the active commands
without these delays, newest first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Compensation, Estimator, Wheels
from diffdrive_mpc.mpc.estimate import SENSORS
from diffdrive_mpc.mpc.problem.slip import FLAT_SLIPS, Slip
from oracle.commands import PastCommands
from oracle.motion import arc, jacobian, sideways, slid, wrap


class Belief(NamedTuple):
    """Mean (n + 16,), covariance, and per sensor the number of samples since an outlier, 0 without outlier.

    `rate` (2,) is the derivative of the model's output over the previous sample [m/s^2, rad/s^2].
    """

    mean: FloatArray
    covariance: FloatArray
    surprised: tuple[int, ...] = (0,) * len(SENSORS)
    rate: FloatArray | float = 0.0


def delay_commands(acting: FloatArray, samples: FloatArray) -> FloatArray:
    """Return the interpolated commands (2, ...) `samples` (2, ...) before the newest, the first of `acting` (m, 2)."""
    whole_samples = np.minimum(np.floor(np.real(samples)).astype(int), len(acting) - 2)
    near, far = (np.stack([acting[whole_samples[i] + step, i] for i in (0, 1)]) for step in (0, 1))
    return near + (samples - whole_samples) * (far - near)


class SlipFilter:
    """Prediction and correction over one sample.

    `wheel_yaw_ratio` is the yaw rate from encoders and geometric track over that of the model, at omega_gain = 1.
    """

    def __init__(
        self, model: DiscreteModel, settings: Estimator, compensation: Compensation, wheel_yaw_ratio: float
    ) -> None:
        self.model, self.settings, self.wheel_yaw_ratio = model, settings, wheel_yaw_ratio
        n, s, use = model.order, settings, compensation
        self.slip_index, self.delay_index, self.pose_index = (
            n + np.arange(11),
            n + 11 + np.arange(2),
            n + 13 + np.arange(3),
        )
        self.spare = int(np.ceil(s.max_delay / model.dt)) if use.dead_time and use.delay else 0
        self.gains = np.array([n + 1, n + 2, n + 3])
        estimated = np.array([use.v_offset, use.yaw_gain, use.v_offset, use.yaw_gain, *[use.side_slip] * 6, True])
        names = [*FLAT_SLIPS, "gyro_bias"]
        # Both directions of the slide have the same uncertainty.
        names = ["slide" if name.startswith("slide") else name for name in names]
        self.uncertainty = estimated * [getattr(s, f"{name}_uncertainty") for name in names]
        self.drift = estimated * [getattr(s, f"{name}_drift") for name in names]
        expected = Slip(side_slip=s.side_slip, load_shift=s.load_shift) if use.side_slip else Slip()
        self.expected = np.array([*expected.flat, 0.0])
        self.patience = round(s.lasting_surprise / model.dt)

    # Prediction of the robot.

    def twist(self, z: FloatArray, output: FloatArray | None = None) -> FloatArray:
        """Compute v, omega (2, ...) of the body from the model's `output` (2, ...), by default that of the state."""
        v, omega = self.model.C @ z[: self.model.order] if output is None else output
        v_offset, omega_gain, longitudinal_gain, yaw_gain = z[self.slip_index[:4]]
        turn_left = z[self.slip_index[6]]
        turning = omega_gain * yaw_gain * omega
        return np.stack([longitudinal_gain * (v + v_offset) + turn_left * turning, turning])

    def process(self, z: FloatArray, acting: FloatArray, acceleration: float) -> FloatArray:
        """Predict z one sample later: states by the model, pose along the arc of the mean twist, constant slip.

        `acceleration` is the result of the method `acceleration` at the mean: the filter treats it as known.
        """
        n, x = self.model.order, self._next(z, acting)
        v, omega = self.twist(z, 0.5 * self.model.C @ (z[:n] + x))
        next_pose = self._moved(z, v, omega, acceleration, self.model.dt)
        return np.concatenate([x, z[self.slip_index], z[self.delay_index], next_pose])

    def acceleration(self, z: FloatArray, acting: FloatArray) -> float:
        """Compute the acceleration of the body's forward speed over the sample [m/s^2]."""
        next_twist = self.twist(z, self.model.C @ self._next(z, acting))
        return float((next_twist - self.twist(z))[0] / self.model.dt)

    def _next(self, z: FloatArray, acting: FloatArray) -> FloatArray:
        model, delay = self.model, z[self.delay_index] / self.model.dt
        recent, older = delay_commands(acting, delay), delay_commands(acting, delay + 1)
        return model.A @ z[: model.order] + model.B0 @ recent + model.B1 @ older

    def _moved(self, z: FloatArray, v: FloatArray, omega: FloatArray, acceleration: float, dt: float) -> FloatArray:
        pose = z[self.pose_index]
        side_slip, turn_ahead, _, load_shift, *slide = z[self.slip_index[4:10]]
        lateral = sideways(v, omega, side_slip, turn_ahead - load_shift * acceleration)
        dx, dy = slid(pose[2], omega, dt, slide)
        return pose + np.stack(arc(pose[2], v, omega, dt, lateral)) + np.stack([dx, dy, 0.0 * dx])

    # Prediction of the sensors, with `change` (2,) [m/s, rad/s] added to the model's output.

    def _output(self, z: FloatArray, change: FloatArray | float) -> FloatArray:
        return np.asarray(((self.model.C @ z[: self.model.order]).T + change).T)

    def wheel_speed(self, z: FloatArray, change: FloatArray | float = 0.0) -> FloatArray:
        """Compute the forward speed of the wheels [m/s]."""
        return self._output(z, change)[0] + z[self.slip_index[0]]

    def wheel_yaw_rate(self, z: FloatArray, change: FloatArray | float = 0.0) -> FloatArray:
        """Compute the yaw rate from encoders and geometric track [rad/s]."""
        return self.wheel_yaw_ratio * z[self.slip_index[1]] * self._output(z, change)[1]

    def yaw_rate(self, z: FloatArray, change: FloatArray | float = 0.0) -> FloatArray:
        """Compute the yaw rate of the gyro [rad/s]."""
        return self.twist(z, self._output(z, change))[1] + z[self.slip_index[10]]

    def pose(self, z: FloatArray, ahead: float) -> FloatArray:
        """Compute the pose (3, ...) `ahead` seconds later, at constant twist."""
        return self._moved(z, *self.twist(z), 0.0, ahead)

    # The filter.

    def moving(self, commands: PastCommands) -> Belief:
        """Return the state of a robot that follows the sent commands by the model, at an unknown position."""
        model, n = self.model, self.model.order
        x = model.settled_state(commands.acting(commands.oldest)[1])
        for ticks_ago in range(commands.oldest, -1, -1):
            recent, older = commands.acting(ticks_ago)[:2]
            x = model.A @ x + model.B0 @ recent + model.B1 @ older
        settled = np.column_stack([model.settled_state(unit) for unit in np.eye(2)])
        P = np.zeros((n + 16, n + 16))
        P[:n, :n] = settled @ np.diag((model.C @ x) ** 2) @ settled.T
        P[self.slip_index, self.slip_index] = self.uncertainty**2
        P[self.delay_index, self.delay_index] = (self.spare > 0) * self.settings.delay_uncertainty**2
        return Belief(np.concatenate([x, self.expected, np.zeros(5)]), P)

    def placed(self, motion: Belief, pose: FloatArray, covariance: FloatArray) -> Belief:
        """Return the state of `motion` at another `pose` (3,) with the covariance (3, 3)."""
        mean, P, index = motion.mean.copy(), motion.covariance.copy(), self.pose_index
        mean[index] = pose
        P[index, :] = P[:, index] = 0.0
        P[np.ix_(index, index)] = covariance
        return Belief(mean, P, rate=motion.rate)

    def slip(self, z: FloatArray) -> Slip:
        """Return the slip in a state."""
        return Slip(*z[self.slip_index[:10]].tolist())

    def twist_deviation(self, belief: Belief) -> FloatArray:
        """Return the standard deviations (2,) of v [m/s] and omega [rad/s]."""
        T = jacobian(self.twist, belief.mean)
        return np.sqrt(np.maximum(np.diag(T @ belief.covariance @ T.T), 0.0))

    def weighed(self, belief: Belief) -> FloatArray:
        """Return the mean (n + 16,) for the controller, without differences from the prior that noise can explain."""
        s, n, mean = self.settings, self.model.order, belief.mean.copy()
        for group, noise, model_error in (
            ([n + 5, n + 6, n + 8, n + 9], s.slide_evidence, 0.0),
            ([n + 1], s.gain_evidence, s.gain_doubt),
            *(([index], s.delay_evidence, s.delay_doubt) for index in self.delay_index),
        ):
            P = belief.covariance[np.ix_(group, group)]
            difference = belief.mean[group] - np.array([*self.expected, 0.0, 0.0])[np.array(group) - n]
            if not P.any():
                continue
            squared = difference @ np.linalg.solve(P + model_error**2 * np.eye(len(group)), difference)
            share = min(1.0, noise**2 / squared) ** (2 if group == [n + 1] else 1) if squared else 1.0
            mean -= share * belief.covariance[:, group] @ np.linalg.solve(P, difference)
        return self.bounded(mean)

    def bounded(self, mean: FloatArray) -> FloatArray:
        """Limit gains and delays to their bounds."""
        mean[self.gains] = np.clip(mean[self.gains], self.settings.min_gain, self.settings.max_gain)
        mean[self.delay_index] = np.clip(mean[self.delay_index], 0.0, self.spare * self.model.dt)
        return mean

    def predict(self, belief: Belief, acting: FloatArray) -> Belief:
        """Predict one sample ahead."""
        model, s, n, z = self.model, self.settings, self.model.order, belief.mean
        acceleration = self.acceleration(z, acting)
        mean = self.process(z, acting, acceleration)
        F = jacobian(lambda points: self.process(points, acting, acceleration), z)
        drive = model.B0 + model.B1
        Q = np.zeros_like(F)
        Q[:n, :n] = drive @ np.diag([s.v_input_noise**2, s.omega_input_noise**2]) @ drive.T
        # A gain is observable only while its channel moves; otherwise its uncertainty must not grow.
        v, omega = np.abs(self.twist(z, 0.5 * model.C @ (z[:n] + mean[:n])))
        driving, turning = v >= s.min_speed, omega >= s.min_yaw_rate
        cornering = driving and turning
        moving = [True, turning, driving, turning, cornering, turning, turning, cornering, turning, turning, True]
        Q[self.slip_index, self.slip_index] = self.drift**2 * model.dt * moving
        Q[self.delay_index, self.delay_index] = (
            (self.spare > 0) * s.delay_drift**2 * model.dt * np.array([driving, turning])
        )
        walk = np.array([s.position_drift, s.position_drift, s.heading_drift])
        Q[self.pose_index, self.pose_index] = walk**2 * model.dt
        counts = tuple(count + (count > 0) for count in belief.surprised)
        rate = model.C @ (mean[:n] - z[:n]) / model.dt
        return Belief(mean, F @ belief.covariance @ F.T + Q, counts, rate)

    def correct(
        self, belief: Belief, sensor: str, value: float, variance: float, ahead: float = 0.0
    ) -> tuple[Belief, float]:
        """Correct with a value `ahead` [s] after the state; return belief and squared innovation over its variance."""
        function = {"wheel_speed": self.wheel_speed, "wheel_yaw_rate": self.wheel_yaw_rate, "yaw_rate": self.yaw_rate}
        h = function[sensor]
        H = jacobian(lambda z: h(z, ahead * belief.rate)[None], belief.mean)
        innovation = np.array([value - float(h(belief.mean, ahead * belief.rate))])
        # A push changes the velocity that the sensor measures, and the corresponding states.
        n, channel = self.model.order, np.eye(2)[0 if sensor == "wheel_speed" else 1]
        push = np.zeros_like(belief.covariance)
        settled = self.model.settled_state(channel)
        push[:n, :n] = innovation**2 * np.outer(settled, settled)
        return self._correct(belief, sensor, H, innovation, np.array([[variance]]), push)

    def correct_pose(
        self, belief: Belief, value: FloatArray, covariance: FloatArray, ahead: float
    ) -> tuple[Belief, float]:
        """Correct with a pose (3,) `ahead` [s] after the state; return belief and normalised squared innovation."""
        H = jacobian(lambda z: self.pose(z, ahead), belief.mean)
        innovation = value - self.pose(belief.mean, ahead)
        innovation[2] = wrap(innovation[2])
        push = np.zeros_like(belief.covariance)
        push[self.pose_index, self.pose_index] = innovation**2
        return self._correct(belief, "pose", H, innovation, covariance, push)

    def _correct(
        self, belief: Belief, sensor: str, H: FloatArray, innovation: FloatArray, R: FloatArray, push: FloatArray
    ) -> tuple[Belief, float]:
        """Correct the state; an outlier counts as a push and does not change slip, unless it lasts."""
        s, z, P = self.settings, belief.mean, belief.covariance
        normalised = float(innovation @ np.linalg.solve(H @ P @ H.T + R, innovation)) / len(innovation)
        surprising, index = normalised > s.surprise, SENSORS.index(sensor)
        counts = list(belief.surprised)
        counts[index] = max(1, counts[index]) if surprising else 0
        pushed = surprising and counts[index] <= self.patience
        P = P + push if pushed else P
        S = H @ P @ H.T + R
        K = np.linalg.solve(S, H @ P).T
        if pushed:
            K[self.slip_index] = K[self.delay_index] = 0.0
        elif abs(self.twist(z)[1]) < s.min_yaw_rate:
            K[self.gains[[0, 2]]] = K[self.delay_index[1]] = 0.0
        mean = self.bounded(z + K @ innovation)
        # Joseph's form holds for any gain.
        I_KH = np.eye(len(z)) - K @ H
        P = I_KH @ P @ I_KH.T + K @ R @ K.T
        return Belief(mean, 0.5 * (P + P.T), tuple(counts), belief.rate), normalised


def build_filter(
    model: DiscreteModel, settings: Estimator, compensation: Compensation | None = None, wheels: Wheels | None = None
) -> SlipFilter:
    """Build the filter of a robot; the ratio of the tracks of `wheels` scales the yaw rate of the encoders."""
    wheels = wheels or Wheels()
    ratio = wheels.track / wheels.encoder_track / float(model.dc_gain[1, 1])
    return SlipFilter(model, settings, compensation or Compensation(), ratio)
