"""The tracking problem linearised along a plan and condensed to a small dense quadratic program in the commands.

Twists and headings are linear in the commands with constant matrices; only the positions need a new linearisation at
each tick. Their rows are sums over arcs, so a running sum replaces the loop over the horizon.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.bounds import command_box, slew_step
from diffdrive_mpc.mpc.problem import TrackingProblem, arc_derivatives
from diffdrive_mpc.mpc.qp.least_distance import ArrayLeastDistance
from diffdrive_mpc.mpc.qp.limit_rows import LimitRows, broken
from diffdrive_mpc.mpc.qp.relaxed import relax
from diffdrive_mpc.mpc.quadratic_program import Kinds, Relaxed
from diffdrive_mpc.mpc.solver_report import SolverStatus
from diffdrive_mpc.mpc.tick import Tick


@dataclass(frozen=True)
class CondensedProgram:
    """Implements `mpc.quadratic_program.QuadraticProgram` with arrays."""

    H: FloatArray
    g: FloatArray
    box: FloatArray
    slew: FloatArray
    last_command: FloatArray
    soft: FloatArray
    soft_lower: FloatArray
    soft_upper: FloatArray

    def soft_values(self, plan: FloatArray) -> FloatArray:
        """See `QuadraticProgram`."""
        return self.soft @ plan

    def soft_rows(self, kind: int) -> FloatArray:
        """See `QuadraticProgram`."""
        return np.asarray(self.soft[kind])

    def relax(self) -> Relaxed | SolverStatus:
        """See `QuadraticProgram`."""
        return relax(self)

    def broken(self, plan: FloatArray, slack: float) -> Kinds:
        """See `QuadraticProgram`."""
        rows = LimitRows(len(plan) // 2)
        rows.load(self)
        return broken(rows.excess(rows.values(plan)), slack)

    def least_distance(self, relaxed: Relaxed, kinds: Kinds) -> ArrayLeastDistance:
        """See `QuadraticProgram`."""
        return ArrayLeastDistance(self, relaxed, kinds)


class Condenser:
    """Turns ticks into quadratic programs. Holds what is constant for one problem, and its work space."""

    def __init__(self, problem: TrackingProblem) -> None:
        self._problem = problem
        N, self._dt = problem.steps, problem.model.dt
        prediction, w = problem.prediction, problem.config.weights
        self._from_plan = prediction.from_plan
        self._mean_v = np.ascontiguousarray(prediction.mean_from_plan[0::2])
        self._mean_omega = np.ascontiguousarray(prediction.mean_from_plan[1::2])
        self._heading = np.ascontiguousarray(prediction.heading_from_plan)
        weights = problem.pose_weights()
        self._root_weights = np.sqrt(weights[:, :2])
        self._heading_weights = weights[:, 2]
        command_weights = np.tile([w.v, w.omega], N)
        self._command_weights = command_weights
        self._first_increment = np.array([w.v_increment, w.omega_increment])
        difference = np.eye(2 * N) - np.eye(2 * N, k=-2)
        increments = np.tile(self._first_increment, N)
        weighted_heading = self._heading_weights[:, None] * self._heading[1:]
        self._constant_hessian = np.diag(command_weights) + difference.T @ (increments[:, None] * difference)
        self._heading_hessian = self._heading[1:].T @ weighted_heading
        self._heading_gradient = weighted_heading.T
        by_channel = self._from_plan[2:].reshape(N, 2, 2 * N)
        self._by_plan = np.ascontiguousarray(by_channel.transpose(1, 0, 2))
        self._soft = np.empty((5, N, 2 * N))
        # Speeds at the rim are those of the model's twist: no gain changes them.
        self._soft[2:4] = np.einsum("rc,kcu->rku", problem.twist_rows(np.ones(2))[2:], by_channel)
        self._stack = np.empty((2 * N, 2 * N))
        self._arcs_in = np.empty((4, N))
        self._arcs_out = np.empty((N, 8))
        self._arc_buffer, self._arc_call = arc_derivatives(N, self._dt).buffer()
        for row in range(4):
            self._arc_buffer.set_arg(row, memoryview(self._arcs_in[row]))  # type: ignore[call-arg]  # wrong in casadi's stubs
        self._arc_buffer.set_res(0, memoryview(self._arcs_out))  # type: ignore[call-arg, arg-type]

    def poses(self, tick: Tick, plan: FloatArray) -> FloatArray:
        """(N + 1, 3) poses that follow from `plan` (N, 2), by exact arcs; fills the arcs' derivatives on the way."""
        twist = tick.free_twist + tick.gains * (self._from_plan @ plan.ravel()).reshape(-1, 2)
        mean = 0.5 * (twist[:-1] + twist[1:])
        poses = np.empty_like(tick.reference)
        poses[0] = tick.pose
        np.cumsum(self._dt * mean[:, 1], out=poses[1:, 2])
        poses[1:, 2] += tick.pose[2]
        self._arcs_in[0] = poses[:-1, 2]
        self._arcs_in[1:3] = mean.T
        self._arcs_in[3] = tick.side_slip
        self._arc_call()
        np.cumsum(self._arcs_out[:, :2], axis=0, out=poses[1:, :2])
        poses[1:, :2] += tick.pose[:2]
        return poses

    def condense(self, tick: Tick, plan: FloatArray) -> CondensedProgram:
        """Linearise along `plan` (N, 2) and condense."""
        problem, N = self._problem, self._problem.steps
        poses = self.poses(tick, plan)
        v_gain, omega_gain = tick.gains.tolist()
        # The derivatives by v, omega and theta, each with the gain between the model's twist and the body's.
        by_twist = self._arcs_out[:, 2:] * np.tile([v_gain, omega_gain, omega_gain], 2)
        headings = self._heading[:-1]
        moves = [
            np.cumsum(
                by_twist[:, i, None] * self._mean_v
                + by_twist[:, i + 1, None] * self._mean_omega
                + by_twist[:, i + 2, None] * headings,
                axis=0,
            )
            for i in (0, 3)
        ]
        error = poses[1:] - tick.reference[1:]
        turned = poses[1:, 2] - tick.heading[1:]
        direction = tick.reference[1:, 2]
        c, s = np.cos(direction), np.sin(direction)
        across = c[:, None] * moves[1] - s[:, None] * moves[0]
        across_error = c * error[:, 1] - s * error[:, 0]
        stack = self._stack
        stack[:N] = self._root_weights[:, :1] * (c[:, None] * moves[0] + s[:, None] * moves[1])
        stack[N:] = self._root_weights[:, 1:] * across

        flat = plan.ravel()
        residual = np.concatenate(
            [self._root_weights[:, 0] * (c * error[:, 0] + s * error[:, 1]), self._root_weights[:, 1] * across_error]
        )
        H = stack.T @ stack + self._constant_hessian + omega_gain**2 * self._heading_hessian
        g = stack.T @ (residual - stack @ flat)
        g += omega_gain * (self._heading_gradient @ (turned - omega_gain * (self._heading[1:] @ flat)))
        g -= self._command_weights * tick.feed_forward.ravel()
        g[:2] -= self._first_increment * tick.last_command

        np.multiply(self._by_plan, tick.gains[:, None, None], out=self._soft[:2])
        self._soft[4] = across
        rows = problem.twist_rows(tick.gains)
        offset = np.vstack([rows @ tick.free_twist[1:].T, across_error - across @ flat])
        soft_limits = problem.soft_limits(tick)[:, None]
        limits = problem.config.limits
        return CondensedProgram(
            H=H,
            g=g,
            box=command_box(limits, self._dt, tick.last_command, N).ravel(),
            slew=slew_step(limits, self._dt),
            last_command=tick.last_command,
            soft=self._soft,
            soft_lower=-soft_limits - offset,
            soft_upper=soft_limits - offset,
        )
