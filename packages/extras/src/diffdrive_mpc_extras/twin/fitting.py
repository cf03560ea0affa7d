"""Fit a plant to a log, and report the determined parameters.

Bounded least squares on the errors of free runs (`scipy.optimize.least_squares`, trust region reflective): the errors
are smooth, a start within the right valley comes from the identified model, and a drive of the plant takes seconds, so
slopes by differences pay where a population of candidates (differential evolution, CMA-ES) would need hundreds of
drives more. Priors are used with the readings, so parameters that these do not determine keep their prior value.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot
from diffdrive_mpc_extras.twin.free_run import FreeMotion
from diffdrive_mpc_extras.twin.problem import TwinProblem
from diffdrive_mpc_extras.twin.settings import twin_settings
from diffdrive_mpc_extras.twin.space import Space, Values

_ENOUGH = 1e-4
"""Fall of the sum of squares, as a part of it, below which the search ends."""


@dataclass(frozen=True)
class FittedParameter:
    """Posterior of one parameter.

    Attributes
    ----------
    name, unit, words
        Name, unit and description of the parameter.
    value
        In the plant.
    low, high
        Bounds of its 95 % interval: of the posterior where the log determines it, else of the prior.
    share
        Posterior deviation over the prior's [-].
    told
        Whether the log determines it; otherwise `value` is the prior's.
    """

    name: str
    unit: str
    words: str
    value: float
    low: float
    high: float
    share: float
    told: bool


@dataclass(frozen=True)
class TwinFit:
    """A plant fitted to a log.

    Attributes
    ----------
    space
        The parameters.
    values
        Their values, by name.
    parameters
        Result of each parameter, in the order of the space.
    drives
        Number of sets of parameters that were driven.
    seconds
        Duration of the log that was fitted [s].
    """

    space: Space
    values: Values
    parameters: tuple[FittedParameter, ...]
    drives: int
    seconds: float

    @property
    def robot(self) -> SimulatedRobot:
        """The plant."""
        return self.space.robot(self.values)


def fit_twin(problem: TwinProblem, start: Values, on_stage: Callable[[str, int], None] | None = None) -> TwinFit:
    """Fit a plant.

    Parameters
    ----------
    problem
        Problem to fit; its weights are found here.
    start
        Values to begin with, by name; other parameters begin at their prior.
    on_stage
        Called with the next step, and the approximate number of its drives.

    Raises
    ------
    ValueError
        If the plant does not come through the log's commands at the start.
    """
    settings, space = twin_settings(), problem.space
    search = _Search(problem)
    announce = on_stage or (lambda _text, _count: None)
    every = list(range(len(space.names)))
    z = space.deviations(start)
    first = search.motions(z)
    if first is None:
        raise ValueError("the plant tips over or diverges under the commands of this log: check mass, sizes and units")
    problem.weigh(problem.errors(z, first))
    for round_, evaluations in enumerate(settings.evaluations):
        announce(f"fit, part {round_ + 1} of 3", evaluations + len(every))
        z = search.least(z, every, evaluations)
        if round_ == 0:
            problem.weigh(problem.errors(z, search.motions(z)))
    announce("fit, part 3 of 3", settings.refined + len(every))
    deviation, information, slopes = search.posterior(z)
    distinct = told_apart(information, settings.told)
    free = [i for i in every if distinct[i]]
    moved = z.copy()
    fixed = [i for i in every if not distinct[i]]
    if fixed and free:
        # Values of the others when these return to their prior, to first order.
        moved[free] += np.linalg.solve(information[np.ix_(free, free)], information[np.ix_(free, fixed)] @ z[fixed])
    moved[fixed] = 0.0
    low, high = space.bounds
    moved = np.clip(moved, low + 1e-6, high - 1e-6)
    z = search.least(moved, free, settings.refined, slopes[:, free]) if free else moved
    values = space.values(z)
    known = []
    for i, (name, prior) in enumerate(space.priors.items()):
        known_to = float(np.hypot(deviation[i], prior.floor / prior.deviation)) if distinct[i] else 1.0
        reach = settings.interval * known_to
        low_end, end = (float(np.clip(prior.value(z[i] + side * reach), prior.low, prior.high)) for side in (-1, 1))
        share = float(deviation[i])
        known.append(
            FittedParameter(name, prior.unit, prior.words, values[name], low_end, end, share, bool(distinct[i]))
        )
    seconds = sum(stretch.experiment.samples * stretch.experiment.dt for stretch in problem.stretches)
    return TwinFit(space, values, tuple(known), search.drives, seconds)


def told_apart(information: FloatArray, threshold: float) -> list[bool]:
    """Select the identifiable parameters: the least identifiable ones return to their prior one by one.

    Of two that it cannot separate, one is kept: the slightly better determined one.
    """
    free = list(range(len(information)))
    while free:
        deviation = np.sqrt(np.diag(np.linalg.inv(information[np.ix_(free, free)])))
        worst = int(np.argmax(deviation))
        if deviation[worst] <= threshold:
            break
        free.pop(worst)
    return [i in free for i in range(len(information))]


class _Search:
    """Least squares of a problem, with the drives at the last point kept."""

    def __init__(self, problem: TwinProblem) -> None:
        self.problem = problem
        self.drives = 0
        self._at: FloatArray | None = None
        self._motions: list[FreeMotion] | None = None

    def motions(self, z: FloatArray) -> list[FreeMotion] | None:
        if self._at is None or not np.array_equal(z, self._at):
            self._at, self._motions = z.copy(), self.problem.motions(z)
            self.drives += 1
        return self._motions

    def differences(self, z: FloatArray, free: list[int], motions: list[FreeMotion]) -> FloatArray:
        """Compute `TwinProblem.slopes`, and count the call."""
        self.drives += sum(self.problem.drives(free))
        return self.problem.slopes(z, free, motions)

    def least(self, z: FloatArray, free: list[int], evaluations: int, known: FloatArray | None = None) -> FloatArray:
        """Search for the least sum of squares over the parameters `free`: (q,).

        Slopes are found by differences at every other step, and follow the steps in between (Broyden, Mathematics of
        Computation 1965, 19(92), 577-593); at the first they may be `known` (n, len(free)).
        """
        problem, (low, high) = self.problem, self.problem.space.bounds

        def whole(part: FloatArray) -> FloatArray:
            point = z.copy()
            point[free] = part
            return point

        def errors(part: FloatArray) -> FloatArray:
            point = whole(part)
            return np.concatenate([problem.rows(problem.errors(point, self.motions(point))), part])

        last: list[FloatArray] = []
        calls = itertools.count(0 if known is None else 1)

        def slopes(part: FloatArray) -> FloatArray:
            point = whole(part)
            motions = self.motions(point)
            assert motions is not None
            now, call = problem.rows(problem.errors(point, motions)), next(calls)
            if last and call % 2:
                then, before, old = last
                step = part - before
                new = old + np.outer(now - then - old @ step, step) / max(float(step @ step), 1e-12)
            elif known is not None and not last:
                new = known
            else:
                new = self.differences(point, free, motions)
            last[:] = [now, part.copy(), new]
            return np.vstack([new, np.eye(len(free))])

        start = np.clip(z[free], low[free] + 1e-9, high[free] - 1e-9)
        solution = least_squares(
            errors, start, slopes, bounds=(low[free], high[free]), ftol=_ENOUGH, xtol=1e-4, max_nfev=evaluations
        )
        return whole(solution.x)

    def posterior(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute deviations (q,) over the prior's, information (q, q) of readings and priors, and slopes (n, q).

        The deviations are those of the information, or where parts of the log differ by more, those of their scatter.
        """
        problem = self.problem
        motions = self.motions(z)
        assert motions is not None
        every = list(range(len(z)))
        slopes = self.differences(z, every, motions)
        errors = problem.rows(problem.errors(z, motions))
        information = slopes.T @ slopes + np.eye(len(z))
        covariance = np.linalg.inv(information)
        scores = np.array([slopes[rows].T @ errors[rows] for rows in problem.blocks()])
        scores -= scores.mean(axis=0)
        spread = covariance @ (scores.T @ scores + np.eye(len(z))) @ covariance
        return np.sqrt(np.maximum(np.diag(covariance), np.diag(spread))), information, slopes
