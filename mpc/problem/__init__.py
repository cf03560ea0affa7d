"""The tracking problem in CasADi: the nonlinear program itself, and the derivatives of the arcs.

With U = (u_0, ..., u_{N-1}), u = (v_ref, omega_ref), the cost is half the weighted sum of squares of

* the position error along and across the reference's heading and the error of the heading, a lead against side-slip
  included, at the samples 1 to N, the last one weighted `terminal` times,
* the deviation of each u_k from its feed-forward, and the increments u_k - u_{k-1}, u_{-1} being the last command sent,

plus an exact penalty on each soft limit that is exceeded. Poses follow from the mean twist over each sample by exact
arcs with side-slip; twists are linear in U.
"""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import arc_function
from diffdrive_mpc.mpc.bounds import command_box, slew_step
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.prediction import Prediction, build_prediction
from diffdrive_mpc.mpc.tick import Tick


@cache
def arc_derivatives(steps: int, dt: float) -> ca.Function:
    """Displacement of each of `steps` arcs with its gradient, in one call.

    Maps theta, v, omega, side-slip, each (1, steps), to (8, steps): dx, dy, then the derivatives of dx and of dy with
    respect to v, omega and theta.
    """
    theta, v, omega, side_slip = (ca.SX.sym(name) for name in ("theta", "v", "omega", "side_slip"))
    move = arc_function()(ca.vertcat(0, 0, theta), v, omega, dt, side_slip)[:2]
    gradient = ca.jacobian(move, ca.vertcat(v, omega, theta))
    columns = ca.vertcat(move, gradient[0, :].T, gradient[1, :].T)
    return ca.Function("arc_derivatives", [theta, v, omega, side_slip], [columns]).map(steps)


class TrackingProblem:
    """One controller's problem: structure, weights and limits; the rest comes with each tick.

    Parameters
    ----------
    config
        Horizon, weights, limits.
    model
        The sampled velocity model, dead time included.

    Raises
    ------
    ValueError
        If the horizon is too short for the dead time: no command could act within it.
    """

    def __init__(self, config: ControllerConfig, model: DiscreteModel) -> None:
        if config.horizon < model.memory:
            raise ValueError(
                f"horizon = {config.horizon}: with its dead time the robot answers to a command after {model.memory} "
                f"steps; set horizon to {model.memory} or more"
            )
        self.config = config
        self.model = model
        self.prediction: Prediction = build_prediction(model, config.horizon)

    @property
    def steps(self) -> int:
        """Horizon N."""
        return self.config.horizon

    def pose_weights(self) -> FloatArray:
        """(N, 3) weights of the errors along, across and in heading at the samples 1 to N."""
        w = self.config.weights
        table = np.tile([w.along, w.across, w.heading], (self.steps, 1))
        table[-1] *= w.terminal
        return table

    def twist_rows(self, gains: FloatArray) -> FloatArray:
        """(4, 2) map from a twist of the body to what has soft limits [m/s, rad/s].

        These are v, omega, and the right and left speed at the rim: the wheels do not slip as the body does,
        so there the `gains` (2,) are undone.
        """
        half = 0.5 * self.config.wheels.track
        (v, omega) = 1 / gains
        return np.array([[1.0, 0.0], [0.0, 1.0], [v, half * omega], [v, -half * omega]])

    def largest_soft(self) -> FloatArray:
        """(5,) limits of the rows of `twist_rows`, and of the distance across the path, as configured."""
        lim = self.config.limits
        return np.array([lim.predicted_v, lim.predicted_omega, lim.wheel_speed, lim.wheel_speed, lim.corridor])

    def soft_limits(self, tick: Tick) -> FloatArray:
        """(5,) limits of the same at this tick.

        Where the robot is already beyond a limit, its present value is the limit: it may not get worse, and a robot
        pushed far off its path does not fight a constraint that no plan can meet.
        """
        x, y, theta = tick.reference[0]
        across = np.cos(theta) * (tick.pose[1] - y) - np.sin(theta) * (tick.pose[0] - x)
        now = np.append(self.twist_rows(tick.gains) @ tick.free_twist[0], across)
        return np.asarray(np.maximum(self.largest_soft(), np.abs(now)))

    def nonlinear_program(self, tick: Tick) -> tuple[dict[str, ca.MX], dict[str, FloatArray]]:
        """The whole problem as a CasADi nonlinear program, for a solver such as IPOPT.

        Returns
        -------
        tuple
            The program with x = (U, p, m), where p, m >= 0 (5 N each) are the amounts by which soft limits are
            exceeded upwards and downwards; and its bounds lbx, ubx, lbg, ubg. The first 2 N entries of the solution
            are the commands, step by step.
        """
        N, dt, w = self.steps, self.model.dt, self.config.weights
        U, p, m = ca.MX.sym("U", 2, N), ca.MX.sym("p", 5, N), ca.MX.sym("m", 5, N)
        by_plan = ca.reshape(ca.DM(self.prediction.from_plan) @ ca.vec(U), 2, N + 1)
        twist = tick.free_twist.T + ca.diag(tick.gains) @ by_plan
        mean = (twist[:, :-1] + twist[:, 1:]) / 2
        arc, pose, cost, across = arc_function(), ca.MX(tick.pose), ca.MX(0), []
        for k, weights in enumerate(self.pose_weights()):
            pose = arc(pose, mean[0, k], mean[1, k], dt, tick.side_slip)
            reference = tick.reference[k + 1]
            c, s = np.cos(reference[2]), np.sin(reference[2])
            error = pose - reference
            turned = pose[2] - tick.heading[k + 1]
            in_path = ca.vertcat(c * error[0] + s * error[1], c * error[1] - s * error[0], turned)
            across.append(in_path[1])
            cost += ca.dot(weights, in_path**2) / 2
        increment = U - ca.horzcat(tick.last_command, U[:, :-1])
        cost += ca.dot([w.v, w.omega], ca.sum2((U - tick.feed_forward.T) ** 2)) / 2
        cost += ca.dot([w.v_increment, w.omega_increment], ca.sum2(increment**2)) / 2
        cost += w.soft * ca.sum1(ca.vec(p + m)) + w.soft_quadratic * (ca.sumsqr(p) + ca.sumsqr(m)) / 2
        soft = ca.vertcat(ca.DM(self.twist_rows(tick.gains)) @ twist[:, 1:], ca.horzcat(*across)) - p + m

        box = command_box(self.config.limits, dt, tick.last_command, N).ravel()
        slew, limit = np.tile(slew_step(self.config.limits, dt), N), np.tile(self.soft_limits(tick), N)
        slack = np.zeros(10 * N)
        program = {"x": ca.veccat(U, p, m), "f": cost, "g": ca.veccat(increment, soft)}
        bounds = {
            "lbx": np.concatenate([-box, slack]),
            "ubx": np.concatenate([box, slack + np.inf]),
            "lbg": -np.concatenate([slew, limit]),
            "ubg": np.concatenate([slew, limit]),
        }
        return program, bounds
