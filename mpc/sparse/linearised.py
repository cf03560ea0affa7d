"""The numbers of one tick, linearised along a plan, that the sparse problem consists of beside its constants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.bounds import command_box, slew_step
from diffdrive_mpc.mpc.problem import TrackingProblem, arc_derivatives
from diffdrive_mpc.mpc.tick import Tick


@dataclass(frozen=True)
class Linearised:
    """Poses along the plan, and how they change with twist and heading.

    Attributes
    ----------
    gains
        (2,) twist of the body over that of the model.
    twists
        (N, 2) the model's twist at the samples 1 to N that comes from the plan.
    moves
        (N, 2, 3) derivatives of each arc's dx and dy with respect to the body's v, omega and theta.
    error
        (N, 3) dx, dy in the world and the deviation from the wanted heading, at the samples 1 to N.
    direction
        (N, 2) cosine and sine of the reference's heading there.
    box, slew
        (N, 2) and (2,): bounds of commands and increments.
    last_command, feed_forward
        (2,) and (N, 2).
    soft_rows
        (4, 2) soft limits as functions of the model's twist; the fifth, the distance across, has none.
    soft_lower, soft_upper
        (5, N) bounds of what plan and deviation from it add.
    """

    gains: FloatArray
    twists: FloatArray
    moves: FloatArray
    error: FloatArray
    direction: FloatArray
    box: FloatArray
    slew: FloatArray
    last_command: FloatArray
    feed_forward: FloatArray
    soft_rows: FloatArray
    soft_lower: FloatArray
    soft_upper: FloatArray


class Lineariser:
    """Linearises ticks of one problem."""

    def __init__(self, problem: TrackingProblem) -> None:
        self._problem = problem
        self._arcs_in, self._arcs_out = np.empty((4, problem.steps)), np.empty((problem.steps, 8))
        self._buffer, self._arcs = arc_derivatives(problem.steps, problem.model.dt).buffer()
        for row in range(4):
            self._buffer.set_arg(row, memoryview(self._arcs_in[row]))  # type: ignore[call-arg]  # wrong in casadi's stubs
        self._buffer.set_res(0, memoryview(self._arcs_out))  # type: ignore[call-arg, arg-type]

    def linearise(self, tick: Tick, plan: FloatArray) -> Linearised:
        """Linearise along `plan` (N, 2)."""
        problem, dt = self._problem, self._problem.model.dt
        by_plan = (problem.prediction.from_plan @ plan.reshape(-1)).reshape(-1, 2)
        twist = tick.free_twist + tick.gains * by_plan
        mean = 0.5 * (twist[:-1] + twist[1:])
        theta = tick.pose[2] + np.concatenate([[0.0], np.cumsum(dt * mean[:, 1])])
        self._arcs_in[0], self._arcs_in[1:3], self._arcs_in[3] = theta[:-1], mean.T, tick.side_slip
        self._arcs()
        arcs = self._arcs_out
        error = np.empty((len(plan), 3))
        error[:, :2] = tick.pose[:2] + np.cumsum(arcs[:, :2], axis=0) - tick.reference[1:, :2]
        error[:, 2] = theta[1:] - tick.heading[1:]
        direction = np.column_stack([np.cos(tick.reference[1:, 2]), np.sin(tick.reference[1:, 2])])
        across = direction[:, 0] * error[:, 1] - direction[:, 1] * error[:, 0]
        rows = problem.twist_rows(tick.gains)
        offset = np.vstack([rows @ tick.free_twist[1:].T, across])
        limit = problem.soft_limits(tick)[:, None]
        limits = problem.config.limits
        return Linearised(
            gains=tick.gains,
            twists=by_plan[1:],
            moves=arcs[:, 2:].reshape(-1, 2, 3).copy(),
            error=error,
            direction=direction,
            box=command_box(limits, dt, tick.last_command, len(plan)),
            slew=slew_step(limits, dt),
            last_command=tick.last_command,
            feed_forward=tick.feed_forward,
            soft_rows=rows * tick.gains,
            soft_lower=-limit - offset,
            soft_upper=limit - offset,
        )
