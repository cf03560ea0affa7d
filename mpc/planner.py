"""One real-time iteration a tick: linearise along the shifted plan, solve, keep the plan."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.begin_tick import begin_tick
from diffdrive_mpc.mpc.bounds import command_box
from diffdrive_mpc.mpc.compiled.condenser import CompiledCondenser
from diffdrive_mpc.mpc.compiled.library import compiled_or_not
from diffdrive_mpc.mpc.condensed import Condenser
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.feed_forward import FeedForward
from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.mpc.solver_report import SolverReport
from diffdrive_mpc.mpc.tick import Tick
from diffdrive_mpc.mpc.ways import make_way


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
        self.ahead: FloatArray = np.asarray(np.arange(feed_forward.samples) * self._dt)
        """Times from now [s] at which a reference is sampled."""
        self._guess: FloatArray | None = None

    @property
    def compiled(self) -> bool:
        """Whether the problem is made in C."""
        return isinstance(self._condenser, CompiledCondenser)

    def reset(self) -> None:
        """Forget the last plan and the solver's warm start."""
        self._guess = None
        self._way.reset()

    def tick(
        self,
        estimate: Estimate,
        past: FloatArray,
        last_command: FloatArray,
        reference: Reference,
        since_start: float,
        sample: ReferenceSample | None = None,
    ) -> Tick:
        """The data of the problem at `since_start` [s] on the reference's clock.

        `past` (memory, 2) are the commands on their way, `last_command` (2,) is the one that slew counts from, and
        `sample` the reference at `since_start + ahead` where that is known already.
        """
        if sample is None:
            sample = reference.sample(since_start + self.ahead)
        return self._begin(estimate, past, last_command, sample)

    def plan(
        self,
        estimate: Estimate,
        past: FloatArray,
        last_command: FloatArray,
        reference: Reference,
        since_start: float,
        sample: ReferenceSample | None = None,
    ) -> tuple[Plan | None, SolverReport]:
        """The next plan, or None where the solver's status does not allow its use; see `tick` for the arguments."""
        tick = self.tick(estimate, past, last_command, reference, since_start, sample)
        if self._guess is None:
            box = command_box(self._config.limits, self._dt, tick.last_command, len(tick.feed_forward))
            self._guess = np.clip(tick.feed_forward, -box, box)
        solution = self._way.solve(tick, self._guess)
        if not (solution.report.status.usable and math.isfinite(np.vdot(solution.plan, solution.plan))):
            self.reset()
            return None, solution.report
        plan = Plan(solution.plan, self._condenser.poses(tick, solution.plan), tick.reference.copy())
        self._guess = np.concatenate((solution.plan[1:], solution.plan[-1:]))
        return plan, solution.report
