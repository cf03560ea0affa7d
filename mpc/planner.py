"""One real-time iteration a tick: linearise along the shifted plan, solve, keep the plan."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from models.interface import FloatArray, Reference
from models.velocity_model import VelocityModel
from mpc.begin_tick import begin_tick
from mpc.bounds import command_box
from mpc.compiled.condenser import CompiledCondenser
from mpc.compiled.library import compiled_or_not
from mpc.condensed import Condenser
from mpc.config import ControllerConfig
from mpc.estimate import Estimate
from mpc.feed_forward import FeedForward
from mpc.problem import TrackingProblem
from mpc.solver_report import SolverReport
from mpc.tick import Tick
from mpc.ways import make_way


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
    """Holds the problem, the way through it and the last plan.

    Raises
    ------
    ValueError
        If the horizon is too short for the dead time.
    """

    def __init__(self, config: ControllerConfig, model: VelocityModel) -> None:
        self._config = config
        self._dt = config.sample_time
        problem = TrackingProblem(config, model.discretise(self._dt))
        feed_forward = FeedForward(model, self._dt, config.horizon)
        self._condenser = compiled_or_not(
            config.solver.compiled, lambda: CompiledCondenser(problem, feed_forward), lambda: Condenser(problem)
        )
        self._begin = (
            self._condenser.begin
            if isinstance(self._condenser, CompiledCondenser)
            else partial(begin_tick, problem, feed_forward)
        )
        self._way = make_way(problem, self._condenser)
        self._times = np.arange(feed_forward.samples) * self._dt
        self._guess: FloatArray | None = None

    def reset(self) -> None:
        """Forget the last plan and the solver's warm start."""
        self._guess = None
        self._way.reset()

    def tick(
        self, estimate: Estimate, past: FloatArray, last_command: FloatArray, reference: Reference, since_start: float
    ) -> Tick:
        """The data of the problem at `since_start` [s] on the reference's clock.

        `past` (memory, 2) are the commands on their way, `last_command` (2,) is the one that slew counts from.
        """
        return self._begin(estimate, past, last_command, reference.sample(since_start + self._times))

    def plan(
        self, estimate: Estimate, past: FloatArray, last_command: FloatArray, reference: Reference, since_start: float
    ) -> tuple[Plan | None, SolverReport]:
        """The next plan, or None where the solver's status does not allow its use."""
        tick = self.tick(estimate, past, last_command, reference, since_start)
        if self._guess is None:
            box = command_box(self._config.limits, self._dt, tick.last_command, len(tick.feed_forward))
            self._guess = np.clip(tick.feed_forward, -box, box)
        solution = self._way.solve(tick, self._guess)
        if not (solution.report.status.usable and np.isfinite(solution.plan).all()):
            self.reset()
            return None, solution.report
        plan = Plan(solution.plan, self._condenser.poses(tick, solution.plan), tick.reference.copy())
        self._guess = np.vstack([solution.plan[1:], solution.plan[-1:]])
        return plan, solution.report
