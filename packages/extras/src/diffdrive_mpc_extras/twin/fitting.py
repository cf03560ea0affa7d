"""Fit of a plant to a log, and the parameters that the log determines.

The method is bounded least squares on the errors of free runs (`scipy.optimize.least_squares`, trust region
reflective). The errors are smooth, and the identified model gives initial values near the minimum. A drive of the plant
takes seconds, and derivatives by finite differences need hundreds of drives fewer than differential evolution or
CMA-ES. Parameters that the readings do not determine keep the median of their prior.
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

_COST_TOLERANCE = 1e-4
"""Relative decrease of the cost below which the search stops."""


@dataclass(frozen=True)
class FittedParameter:
    """Posterior of one parameter.

    Attributes
    ----------
    name, unit, words
        Name, unit and description of the parameter.
    value
        Value in the plant.
    low, high
        Bounds of the 95 % interval: of the posterior if the log determines the parameter, else of the prior.
    share
        Standard deviation of the posterior over that of the prior [-].
    told
        True if the log determines the parameter; otherwise `value` is the median of the prior.
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
    """Result of the fit of a plant to a log.

    Attributes
    ----------
    space
        Space of the parameters.
    values
        Values of the parameters, by name.
    parameters
        Posterior of each parameter, in the order of the space.
    drives
        Number of simulations of the fitted stretches.
    seconds
        Duration of the fitted stretches [s].
    """

    space: Space
    values: Values
    parameters: tuple[FittedParameter, ...]
    drives: int
    seconds: float

    @property
    def robot(self) -> SimulatedRobot:
        """Fitted plant."""
        return self.space.robot(self.values)


def fit_twin(problem: TwinProblem, start: Values, on_stage: Callable[[str, int], None] | None = None) -> TwinFit:
    """Fit a plant.

    Parameters
    ----------
    problem
        Problem to fit; this function sets its weights.
    start
        Initial values, by name; missing parameters start at the median of their prior.
    on_stage
        Called with the name of the next stage, and the approximate number of its drives.

    Raises
    ------
    ValueError
        If the plant tips over or diverges with the initial values.
    """
    settings, space = twin_settings(), problem.space
    search = _Search(problem)
    announce = on_stage or (lambda _text, _count: None)
    indices = list(range(len(space.names)))
    z = space.deviations(start)
    motions = search.motions(z)
    if motions is None:
        raise ValueError("the plant tips over or diverges under the commands of this log: check mass, sizes and units")
    problem.set_weights(problem.errors(z, motions))
    for part, evaluations in enumerate(settings.evaluations):
        announce(f"fit, part {part + 1} of 3", evaluations + len(indices))
        z = search.minimise(z, indices, evaluations)
        if part == 0:
            problem.set_weights(problem.errors(z, search.motions(z)))
    announce("fit, part 3 of 3", settings.refined + len(indices))
    deviation, information, slopes = search.posterior(z)
    is_determined = identifiable_parameters(information, settings.told)
    free = [i for i in indices if is_determined[i]]
    refined = z.copy()
    fixed = [i for i in indices if not is_determined[i]]
    if fixed and free:
        # First-order change of the free parameters when the fixed ones return to the median of their prior.
        refined[free] += np.linalg.solve(information[np.ix_(free, free)], information[np.ix_(free, fixed)] @ z[fixed])
    refined[fixed] = 0.0
    low, high = space.bounds
    refined = np.clip(refined, low + 1e-6, high - 1e-6)
    z = search.minimise(refined, free, settings.refined, slopes[:, free]) if free else refined
    values = space.values(z)
    parameters = []
    for i, (name, prior) in enumerate(space.priors.items()):
        spread = float(np.hypot(deviation[i], prior.floor / prior.deviation)) if is_determined[i] else 1.0
        half_width = settings.interval * spread
        lower, upper = (
            float(np.clip(prior.value(z[i] + side * half_width), prior.low, prior.high)) for side in (-1, 1)
        )
        share = float(deviation[i])
        parameters.append(
            FittedParameter(name, prior.unit, prior.words, values[name], lower, upper, share, bool(is_determined[i]))
        )
    seconds = sum(stretch.experiment.samples * stretch.experiment.dt for stretch in problem.stretches)
    return TwinFit(space, values, tuple(parameters), search.drives, seconds)


def identifiable_parameters(information: FloatArray, threshold: float) -> list[bool]:
    """Select the identifiable parameters from an information matrix (q, q) of readings and unit priors.

    The parameter with the largest deviation is fixed at its prior, one by one, until all deviations are at most
    `threshold`. Of two inseparable parameters, the slightly better determined one stays free.
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
    """Least-squares search that caches the motions at the last point and counts drives."""

    def __init__(self, problem: TwinProblem) -> None:
        self.problem = problem
        self.drives = 0
        self._point: FloatArray | None = None
        self._motions: list[FreeMotion] | None = None

    def motions(self, z: FloatArray) -> list[FreeMotion] | None:
        if self._point is None or not np.array_equal(z, self._point):
            self._point, self._motions = z.copy(), self.problem.motions(z)
            self.drives += 1
        return self._motions

    def slopes(self, z: FloatArray, free: list[int], motions: list[FreeMotion]) -> FloatArray:
        """Compute `TwinProblem.slopes`, and count its drives."""
        self.drives += sum(self.problem.drives(free))
        return self.problem.slopes(z, free, motions)

    def minimise(
        self, z: FloatArray, free: list[int], evaluations: int, first_slopes: FloatArray | None = None
    ) -> FloatArray:
        """Minimise the sum of squares over the parameters `free`, starting at `z` (q,); return the minimum (q,).

        Slopes are computed by finite differences at every other step and updated by the method of Broyden (Mathematics
        of Computation 1965, 19(92), 577-593) in between. `first_slopes` (n, len(free)) are the slopes at `z`, if known.
        """
        problem, (low, high) = self.problem, self.problem.space.bounds

        def full_point(part: FloatArray) -> FloatArray:
            point = z.copy()
            point[free] = part
            return point

        def residuals(part: FloatArray) -> FloatArray:
            point = full_point(part)
            return np.concatenate([problem.rows(problem.errors(point, self.motions(point))), part])

        previous: list[FloatArray] = []
        calls = itertools.count(0 if first_slopes is None else 1)

        def jacobian(part: FloatArray) -> FloatArray:
            point = full_point(part)
            motions = self.motions(point)
            assert motions is not None
            rows, call = problem.rows(problem.errors(point, motions)), next(calls)
            if previous and call % 2:
                previous_rows, previous_part, previous_slopes = previous
                step = part - previous_part
                change = rows - previous_rows - previous_slopes @ step
                slopes = previous_slopes + np.outer(change, step) / max(float(step @ step), 1e-12)
            elif first_slopes is not None and not previous:
                slopes = first_slopes
            else:
                slopes = self.slopes(point, free, motions)
            previous[:] = [rows, part.copy(), slopes]
            return np.vstack([slopes, np.eye(len(free))])

        start, bounds = np.clip(z[free], low[free] + 1e-9, high[free] - 1e-9), (low[free], high[free])
        solution = least_squares(
            residuals, start, jacobian, bounds=bounds, ftol=_COST_TOLERANCE, xtol=1e-4, max_nfev=evaluations
        )
        return full_point(solution.x)

    def posterior(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute posterior over prior deviations (q,), information (q, q) of readings and priors, and slopes (n, q).

        Each deviation is the larger of two: from the information, and from the scatter between blocks of the log.
        """
        problem = self.problem
        motions = self.motions(z)
        assert motions is not None
        slopes = self.slopes(z, list(range(len(z))), motions)
        errors = problem.rows(problem.errors(z, motions))
        information = slopes.T @ slopes + np.eye(len(z))
        covariance = np.linalg.inv(information)
        scores = np.array([slopes[rows].T @ errors[rows] for rows in problem.blocks()])
        scores -= scores.mean(axis=0)
        robust = covariance @ (scores.T @ scores + np.eye(len(z))) @ covariance
        return np.sqrt(np.maximum(np.diag(covariance), np.diag(robust))), information, slopes
