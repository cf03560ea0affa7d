"""One real-time iteration a tick: linearise along the shifted plan, solve, keep the plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.interface import FloatArray, Reference
from models.velocity_model import VelocityModel
from mpc.bounds import command_box
from mpc.condensed import Condenser
from mpc.config import ControllerConfig
from mpc.estimate import Estimate
from mpc.feed_forward import FeedForward
from mpc.lean import lean
from mpc.osqp_solver import OsqpSolver
from mpc.problem import TrackingProblem
from mpc.solver_report import SolverReport
from mpc.tick import Tick


@dataclass(frozen=True)
class Plan:
    """A plan that may be driven.

    Attributes
    ----------
    commands
        (N, 2) v_ref [m/s], omega_ref [rad/s].
    poses
        (N + 1, 3) the poses that they lead to.
    reference
        (N + 1, 3) the poses that it tracks; theta on the turn that the estimate is on.
    """

    commands: FloatArray
    poses: FloatArray
    reference: FloatArray


class Planner:
    """Holds the problem, its solver and the last plan.

    Raises
    ------
    ValueError
        If the horizon is too short for the dead time.
    """

    def __init__(self, config: ControllerConfig, model: VelocityModel) -> None:
        self._config = config
        self._dt = config.sample_time
        self._problem = TrackingProblem(config, model.discretise(self._dt))
        self._condenser = Condenser(self._problem)
        self._solver = OsqpSolver(config.horizon, config.solver, config.weights)
        self._feed_forward = FeedForward(model, self._dt, config.horizon)
        samples = max(self._feed_forward.samples, config.horizon + 1)
        self._times = np.arange(samples) * self._dt
        self._guess: FloatArray | None = None

    def reset(self) -> None:
        """Forget the last plan and the solver's warm start."""
        self._guess = None
        self._solver.reset()

    def tick(
        self, estimate: Estimate, past: FloatArray, last_command: FloatArray, reference: Reference, since_start: float
    ) -> Tick:
        """The data of the problem at `since_start` [s] on the reference's clock.

        `past` (memory, 2) are the commands on their way, `last_command` (2,) is the one that slew counts from.
        """
        sample = reference.sample(since_start + self._times)
        poses = sample.pose[: self._config.horizon + 1].copy()
        # The estimate counts its turns itself: meet it on the turn it is on.
        poses[:, 2] += 2 * np.pi * np.round((estimate.pose[2] - poses[0, 2]) / (2 * np.pi))
        slip = estimate.slip
        aim, heading = lean(poses, sample.twist[: len(poses)], slip.side_slip, self._config.weights)
        free = self._problem.prediction.free_twists(estimate.state, past).reshape(-1, 2)
        return Tick(
            pose=estimate.pose,
            free_twist=slip.gains * (free + slip.offset),
            gains=slip.gains,
            side_slip=slip.side_slip,
            reference=aim,
            heading=heading,
            feed_forward=self._feed_forward.commands(sample.twist, slip),
            last_command=last_command,
        )

    def plan(
        self, estimate: Estimate, past: FloatArray, last_command: FloatArray, reference: Reference, since_start: float
    ) -> tuple[Plan | None, SolverReport]:
        """The next plan, or None where the solver's status does not allow its use."""
        tick = self.tick(estimate, past, last_command, reference, since_start)
        if self._guess is None:
            box = command_box(self._config.limits, self._dt, tick.last_command, len(tick.feed_forward))
            self._guess = np.clip(tick.feed_forward, -box, box)
        solution = self._solver.solve(self._condenser.condense(tick, self._guess), self._guess)
        if not (solution.report.status.usable and np.isfinite(solution.plan).all()):
            self.reset()
            return None, solution.report
        plan = Plan(solution.plan, self._condenser.poses(tick, solution.plan), tick.reference)
        self._guess = np.vstack([solution.plan[1:], solution.plan[-1:]])
        return plan, solution.report
