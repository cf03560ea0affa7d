"""Excitation drive with the most information about a velocity model, for `diffdrive-mpc excite --for model`.

There are two families of twists over time: piecewise-constant twists, and sums of sines. Differential evolution (Storn,
Price, Journal of Global Optimization 1997, 11, 341-359; `scipy.optimize`) maximises the information in each family;
the better result is the drive. The information is a function of the commands, see `excitation.drive_information`. All
members of a family stay inside the room and the limits by construction, so the search has no constraints.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import yaml
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits, load_settings
from diffdrive_mpc_extras.excitation.slip_excitation import WRITTEN_BY

Objective = Callable[[FloatArray], float]
"""Objective of the search, a function of twists (K, 2), one per tick; it is maximised."""

# Lower bound of the normalisation of sums of sines.
_MIN_SCALE = 1e-9


class ModelExcitationSettings(StrictModel):
    """Settings of the search for a drive."""

    tick: Positive
    margin: Positive
    least_reach: Positive
    slew_share: float = Field(gt=0, lt=1)
    calm: Positive
    moves: int = Field(ge=2)
    holds: tuple[Positive, Positive]
    sines: int = Field(ge=1)
    frequencies: tuple[Positive, Positive]
    population: int = Field(ge=5)
    generations: int = Field(ge=1)


@cache
def model_excitation_settings() -> ModelExcitationSettings:
    """Read the settings; raise ConfigError if they are invalid."""
    return load_checked(ModelExcitationSettings, Path(__file__).with_suffix(".yaml"))


@dataclass(frozen=True)
class Room:
    """Rectangular room; the robot starts in the middle and heads along the length.

    Attributes
    ----------
    length, width
        Dimensions [m].

    Raises
    ------
    models.checked_yaml.ConfigError
        If the room is too small to drive in.
    """

    length: float
    width: float

    def __post_init__(self) -> None:
        """Check the dimensions."""
        settings = model_excitation_settings()
        min_size = 2 * (settings.margin + settings.least_reach)
        if not (math.isfinite(self.length) and math.isfinite(self.width) and min(self.length, self.width) >= min_size):
            raise ConfigError(
                f"a room of {self.length:g} by {self.width:g} m: with {settings.margin:g} m distance from the edges, "
                f"length and width must be at least {min_size:g} m"
            )

    @classmethod
    def read(cls, text: str) -> Room:
        """Parse length and width [m], such as `4x3`; raise ValueError for other text."""
        length, _, width = text.replace(",", "x").partition("x")
        try:
            numbers = float(length), float(width)
        except ValueError:
            raise ValueError(f"--inside '{text}': give length and width in metres, such as 4x3") from None
        return cls(*numbers)

    @property
    def reach(self) -> FloatArray:
        """(2,) maximum distance of the path from the middle, along length and width [m]."""
        return 0.5 * np.array([self.length, self.width]) - model_excitation_settings().margin


@dataclass(frozen=True)
class ModelDrive:
    """Twists with the most information.

    Attributes
    ----------
    family
        "steps" or "multi-sine".
    twists
        (K, 2) v [m/s] and omega [rad/s], one per `tick`; the robot starts and ends at rest.
    objectives
        Objective of the best drive of each family.
    """

    family: str
    twists: FloatArray
    objectives: dict[str, float]


def model_excitation(
    room: Room, seconds: float, limits: TrajectoryLimits, objective: Objective, seed: int = 0
) -> ModelDrive:
    """Search for the twists that maximise `objective`.

    Parameters
    ----------
    room
        Room of the drive, which starts in the middle.
    seconds
        Duration of the drive [s].
    limits
        Maximum speeds and accelerations of the drive.
    objective
        Objective function.
    seed
        Seed of the search; the result is reproducible.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the duration is out of range, or no drive of either family contains information.
    """
    settings = model_excitation_settings()
    min_seconds = 2 * settings.holds[1] + 2 * settings.calm
    if not (math.isfinite(seconds) and seconds >= min_seconds):
        raise ConfigError(f"{seconds:g} s: a drive that determines lags and dead times takes {min_seconds:g} s or more")
    max_seconds = load_settings().max_excitation_duration
    if seconds > max_seconds:
        raise ConfigError(f"{seconds:g} s: give at most {max_seconds:g} s; drive it several times for more")
    families: dict[str, _Steps | _Sines] = {
        "steps": _Steps(room, seconds, limits),
        "multi-sine": _Sines(room, seconds, limits),
    }
    candidates = {name: _best(family, objective, seed) for name, family in families.items()}
    values = {name: objective(twists) for name, twists in candidates.items()}
    best = max(values, key=lambda name: values[name])
    if not math.isfinite(values[best]):
        raise ConfigError("no drive determines all of the model's parameters; give more time, room or speed")
    return ModelDrive(best, candidates[best], values)


def evaluated_drives() -> int:
    """Return the number of drives that a search evaluates."""
    settings = model_excitation_settings()
    return 2 * (settings.population * (settings.generations + 1) + 1)


def path_of(twists: FloatArray, tick: float) -> FloatArray:
    """Integrate twists (K, 2), each held for `tick` [s], to (K + 1, 3) poses from (0, 0, 0) by exact arcs."""
    theta = np.concatenate([[0.0], np.cumsum(twists[:, 1]) * tick])
    ahead = integrate_pose(np.column_stack([np.zeros((len(twists), 2)), theta[:-1]]), twists[:, 0], twists[:, 1], tick)
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(ahead[:, :2], axis=0)]), theta])


def write_model_drive(path: str | Path, drive: ModelDrive, tick: float) -> None:
    """Write a trajectory file that `load_trajectory` reads; raise ConfigError if it cannot be written."""
    lines = [
        f"{WRITTEN_BY} --for model`. v [m/s], omega [rad/s], duration [s].",
        f"name: model excitation, {drive.family}",
        "timing: commanded",
        "segments:",
    ]
    for twist, ticks in _group_twists(drive.twists):
        segment = {"v": round(twist[0], 4), "omega": round(twist[1], 4), "duration": round(ticks * tick, 4)}
        lines.append("- " + yaml.safe_dump(segment, sort_keys=False, default_flow_style=True).strip())
    with whole_file(path, begins=WRITTEN_BY.encode()) as draft:
        draft.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _group_twists(twists: FloatArray) -> list[tuple[tuple[float, float], int]]:
    """Group equal consecutive twists; return each twist with its number of ticks."""
    rows = [tuple(map(float, np.round(row, 4))) for row in twists]
    return [((row[0], row[1]), len(list(group))) for row, group in itertools.groupby(rows)]


def _best(family: _Steps | _Sines, objective: Objective, seed: int) -> FloatArray:
    """Search for the best member of the family and return its twists."""
    from scipy import optimize  # noqa: PLC0415 - loads slowly

    settings = model_excitation_settings()
    stream = np.random.default_rng(seed)

    def cost(genes: FloatArray) -> float:
        value = objective(family.twists(genes))
        return -value if math.isfinite(value) else math.inf

    result = optimize.differential_evolution(
        cost,
        [(0.0, 1.0)] * family.genes,
        init=stream.uniform(size=(settings.population, family.genes)),
        maxiter=settings.generations,
        tol=0.0,
        polish=False,
        seed=seed,
    )
    return family.twists(result.x)


class _Sines:
    """Sums of sines in v and omega, faded in and out; v is scaled down if the path does not fit the room."""

    def __init__(self, room: Room, seconds: float, limits: TrajectoryLimits) -> None:
        settings = model_excitation_settings()
        self._reach, self._tick, self._sines = room.reach, settings.tick, settings.sines
        self._max_twist = np.array([limits.v, limits.omega])
        self._slope = np.array([limits.v_acceleration, limits.omega_acceleration])
        self._times = settings.tick * (np.arange(round(seconds / settings.tick)) + 0.5)
        edge = np.minimum(self._times, seconds - self._times) / settings.calm
        self._fade = np.sin(0.5 * np.pi * np.clip(edge, 0.0, 1.0)) ** 2
        self._low, self._high = np.log(settings.frequencies)
        self.genes = 6 * settings.sines

    def twists(self, genes: FloatArray) -> FloatArray:
        """Build twists (K, 2)."""
        frequency, amplitude, phase = genes.reshape(3, 2, self._sines)
        angle = 2 * np.pi * np.exp(self._low + (self._high - self._low) * frequency)[..., None] * self._times
        rows = np.sum(amplitude[..., None] * np.sin(angle + 2 * np.pi * phase[..., None]), axis=1) * self._fade
        steps = np.abs(np.diff(np.pad(rows, ((0, 0), (1, 1))))).max(axis=1) / (self._slope * self._tick)
        rows /= np.maximum(np.maximum(np.abs(rows).max(axis=1) / self._max_twist, steps), _MIN_SCALE)[:, None]
        # The headings do not depend on v, so the path scales with v.
        share = float((np.abs(path_of(rows.T, self._tick)[:, :2]) / self._reach).max())
        rows[0] /= max(share, 1.0)
        return np.ascontiguousarray(rows.T)


class _Steps:
    """Piecewise-constant twists with ramps between them; the signs are chosen so that the path stays in the room."""

    def __init__(self, room: Room, seconds: float, limits: TrajectoryLimits) -> None:
        settings = model_excitation_settings()
        self._reach, self._tick = room.reach, settings.tick
        self._max_twist = np.array([limits.v, limits.omega])
        self._step = settings.tick * np.array([limits.v_acceleration, limits.omega_acceleration])
        self._count = round(seconds / settings.tick)
        self._holds = settings.holds
        self._moves = settings.moves
        self.genes = 3 * settings.moves

    def twists(self, genes: FloatArray) -> FloatArray:
        """Build twists (K, 2)."""
        levels = (2 * genes.reshape(3, self._moves)[:2].T - 1) * self._max_twist
        shortest, longest = self._holds
        holds = shortest * (longest / shortest) ** genes.reshape(3, self._moves)[2]
        pose, twist = np.zeros(3), np.zeros(2)
        rows: list[FloatArray] = []
        stop = int(np.ceil((self._max_twist / self._step).max()))
        left = self._count - stop
        for k in itertools.count():
            if left <= 0:
                break
            level = levels[k % self._moves] * (1.0, 1.0 if k // self._moves % 2 == 0 else -1.0)
            ticks = min(max(1, round(holds[k % self._moves] / self._tick)), left)
            move = self._move(pose, twist, level, ticks, stop)
            rows.append(move)
            pose, twist, left = self._end(pose, move), move[-1], left - len(move)
        rows.append(self._ramp(twist, np.zeros(2), stop))
        return np.vstack(rows)

    def _move(self, pose: FloatArray, twist: FloatArray, level: FloatArray, ticks: int, stop: int) -> FloatArray:
        """Return the twists of the first sign variant after which the robot can stop inside the room."""
        v, omega = level
        for target in ((v, omega), (-v, omega), (v, -omega), (-v, -omega)):
            move = self._ramp(twist, np.array(target), ticks)
            path = self._integrate(pose, np.vstack([move, self._ramp(move[-1], np.zeros(2), stop)]))
            if (np.abs(path[:, :2]) <= self._reach).all():
                return move
        # Braking stays inside the room: the previous moves ensure this.
        return self._ramp(twist, np.array([0.0, 0.0]), max(ticks, 1))

    def _ramp(self, twist: FloatArray, target: FloatArray, ticks: int) -> FloatArray:
        """Build a ramp (ticks, 2) from `twist` to `target` within the acceleration limits, which ends at the target."""
        steps = np.arange(1, ticks + 1)[:, None] * self._step
        return np.asarray(twist + np.clip(target - twist, -steps, steps))

    def _integrate(self, pose: FloatArray, twists: FloatArray) -> FloatArray:
        """Integrate twists (K, 2) from `pose` to (K + 1, 3) poses."""
        path = path_of(twists, self._tick)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        points = pose[:2] + path[:, :2] @ np.array([[c, s], [-s, c]])
        return np.column_stack([points, pose[2] + path[:, 2]])

    def _end(self, pose: FloatArray, twists: FloatArray) -> FloatArray:
        return np.asarray(self._integrate(pose, twists)[-1])
