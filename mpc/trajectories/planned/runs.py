"""What a planner's poses say: which parts are driven forwards, which backwards, and where the robot turns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc.trajectories.planned.settings import load_settings


@dataclass(frozen=True, eq=False)
class Run:
    """A part of a path that is driven in one direction, from one place where the robot stops to the next.

    Attributes
    ----------
    points
        (k, 2), k >= 2, no two neighbours at one place [m].
    sense
        1 forwards, -1 backwards.
    first, last
        Heading that the poses state at its ends [rad]; None where they state none.
    """

    points: FloatArray
    sense: int
    first: float | None
    last: float | None

    @property
    def length(self) -> float:
        """[m]."""
        return float(np.hypot(*np.diff(self.points, axis=0).T).sum())


def read_runs(poses: FloatArray, robot: FloatArray, *, backwards: bool = True) -> list[Run]:
    """Cut a path where its direction changes.

    A part whose poses point against the travel is driven backwards; poses that stay at one place and turn are a turn on
    the spot. Some planners state no headings but the last: all others are 0, exactly. They are not believed where the
    travel, or the robot, is at odds with that; such a path is driven forwards.

    Parameters
    ----------
    poses
        (n, 3) x, y [m], theta [rad], finite.
    robot
        (3,) pose of the robot.
    backwards
        Whether a part may be driven backwards.

    Returns
    -------
    list of Run
        Empty where all poses are at one place.
    """
    settings = load_settings()
    apart = np.hypot(*np.diff(poses[:, :2], axis=0).T) > settings.coincident
    firsts = np.concatenate([[0], np.flatnonzero(apart) + 1])
    lasts = np.concatenate([firsts[1:] - 1, [len(poses) - 1]])
    if firsts.size < 2:
        return []
    points = poses[firsts, :2]
    # The place that ends a path is its last pose's.
    points[-1] = poses[-1, :2]
    arriving, leaving = poses[firsts, 2], poses[lasts, 2]
    step = np.diff(points, axis=0)
    lengths, travel = np.hypot(*step.T), np.arctan2(step[:, 1], step[:, 0])
    agree = np.cos(leaving[:-1] - travel)
    stated = _stated(poses, agree, robot)
    senses = np.where(np.abs(agree) < settings.sideways, 0, np.sign(agree)).astype(int)
    if not (stated and backwards):
        senses = np.ones_like(senses)
    senses = _steady(senses, lengths, settings.least_run)
    turned = np.abs(wrap_angle(leaving - arriving)) > settings.bendable if stated else np.zeros(len(points), dtype=bool)
    cuts = [0, *(i for i in range(1, len(lengths)) if senses[i] != senses[i - 1] or turned[i]), len(lengths)]
    runs: list[Run] = []
    for begin, end in pairwise(cuts):
        first = float(leaving[begin]) if stated else None
        last = float(arriving[end]) if stated or end == len(lengths) else None
        runs += _without_hairpins(Run(points[begin : end + 1], int(senses[begin]), first, last))
    most = settings.turns_allowed + settings.turns_per_metre * float(lengths.sum())
    if len(runs) - 1 > most:
        raise ConfigError(
            f"path: it turns back {len(runs) - 1} times in {lengths.sum():.2f} m; smooth it, or plan another one"
        )
    return runs


def _stated(poses: FloatArray, agree: FloatArray, robot: FloatArray) -> bool:
    """Whether the headings before the last mean something."""
    if np.any(np.abs(poses[:-1, 2]) > 1e-9):
        return True
    sideways = bool(np.any(np.abs(agree) < load_settings().sideways))
    return not sideways and math.cos(float(robot[2])) > load_settings().sideways


def _steady(senses: FloatArray, lengths: FloatArray, least: float) -> FloatArray:
    """Senses (m,) of which each lasts for `least` [m]; where a pose says nothing, the one before holds."""
    known = np.flatnonzero(senses)
    found = (
        np.ones_like(senses)
        if not known.size
        else senses[known[np.searchsorted(known[1:], np.arange(senses.size), side="right")]]
    )
    edges = [0, *(np.flatnonzero(np.diff(found)) + 1).tolist(), found.size]
    for begin, end in pairwise(edges):
        if lengths[begin:end].sum() < least:
            found[begin:end] = found[begin - 1] if begin else found[min(end, found.size - 1)]
    return np.asarray(found)


def _without_hairpins(run: Run) -> list[Run]:
    """Parts between places where the path turns back on itself."""
    settings = load_settings()
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(run.points, axis=0).T))])
    reach = settings.hairpin_length

    def place(s: FloatArray) -> FloatArray:
        return np.column_stack([np.interp(s, along, run.points[:, i]) for i in (0, 1)])

    inside = np.flatnonzero((along > settings.least_run) & (along < along[-1] - settings.least_run))
    here = run.points[inside]
    before, after = here - place(along[inside] - reach), place(along[inside] + reach) - here
    turn = np.abs(np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1)))
    # Beside the place where it turns, the way there and the way back cancel: there the chords are longest.
    sharpness = np.hypot(*before.T) * np.hypot(*after.T)
    cuts: list[int] = []
    for i in sorted(np.flatnonzero(turn > settings.hairpin), key=lambda i: -sharpness[i]):
        if all(abs(along[inside[i]] - along[cut]) > reach for cut in cuts):
            cuts.append(int(inside[i]))
    edges = [0, *sorted(cuts), len(run.points) - 1]
    last = len(edges) - 2
    return [
        Run(
            run.points[begin : end + 1],
            run.sense,
            run.first if i == 0 else None,
            run.last if i == last else None,
        )
        for i, (begin, end) in enumerate(pairwise(edges))
    ]
