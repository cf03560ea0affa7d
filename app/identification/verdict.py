"""Verdict on an identified model: trust by its logs, and results of its trial drives."""

from __future__ import annotations

import math
import shlex
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import gmean

from diffdrive_mpc.app.identification.trial_drives import (
    HELD_OUT,
    PATHS,
    UNEXPLAINED,
    StandIn,
    TrialDrive,
    model_itself,
    stand_ins,
    trial_doubts,
    trial_drives,
    trial_settings,
)
from diffdrive_mpc.app.identification.unexplained_motion import identified_robot
from diffdrive_mpc.models.identification import Identification
from diffdrive_mpc.models.identification.deliver.configuration import CONFIG_FILE, MODEL_FILE
from diffdrive_mpc.models.identification.deliver.trust import Grade
from diffdrive_mpc.models.identification.fit.slip import SURFACE_FILE
from diffdrive_mpc.models.identification.from_logs import identify_data
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc.mpc import ControllerConfig, load_config
from diffdrive_mpc.sim.plants.identified_robot import IdentifiedRobot

SIMPLEST = "sm"
_WIDTH = 80
_HEADS = ("May I drive?", "How fast?", "How good?", "What next?")
DRIVES = 2 * len(PATHS)
"""Trial drives of one configuration without unexplained motion."""


class Promise(NamedTuple):
    """Speeds of curved paths, and errors within which a share of the drives stays."""

    v: float
    """[m/s]"""
    omega: float
    """[rad/s]"""
    lateral: float
    """Distance from the path [m]"""
    position: float
    """Distance from the timed position [m]"""
    share: str
    """Number of drives that stay within, "95 of 100", or fewer if drives with unexplained motion do not arrive"""


@dataclass(frozen=True)
class TrialVerdict:
    """Identification with the trial drives of its configuration.

    Attributes
    ----------
    identification
        The identification, possibly with lower limits or a simpler model where only these pass.
    config
        Configuration of the identified robot; None where none can be written.
    drives
        All that were driven with it.
    changed
        Limits that were lowered and parts that were simplified so that the drives pass, a clause each.
    against
        Why nothing drives, in a clause; empty where the drives pass.
    unexplained
        Curved drives with the motion that the model leaves unexplained in the data held out.
    robot
        With this motion; None without such drives.
    """

    identification: Identification
    config: ControllerConfig | None
    drives: tuple[TrialDrive, ...]
    changed: tuple[str, ...] = ()
    against: str = ""
    unexplained: tuple[TrialDrive, ...] = ()
    robot: IdentifiedRobot | None = None

    @property
    def grade(self) -> Grade:
        """Grade of trust for driving."""
        trust = self.identification.report.trust
        if self.against or trust.grade == "No":
            return "No"
        return "With care" if self.reasons else "Yes"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons against a better grade, a clause each."""
        trust = self.identification.report.trust
        if self.against:
            return (self.against,)
        alone = self.drives and not any(drive.plant == HELD_OUT for drive in self.drives)
        words = ("the data held out are too few for a stand-in of their own",) if alone else ()
        return (*self.changed, *words, *self._rough, *trust.reasons)

    @property
    def _rough(self) -> tuple[str, ...]:
        count = len(self.unexplained)
        if lost := count - len(_errors(self.unexplained)):
            return (f"{lost} of {count} drives of {UNEXPLAINED} do not arrive",)
        if all(drive.passed for drive in self.unexplained):
            return ()
        return (f"{UNEXPLAINED} leaves its path by more than {100 * trial_settings().lateral_share:g} % of a radius",)

    @property
    def promised(self) -> Promise | None:
        """Performance to expect of the robot; None if nothing drives."""
        curved = [drive for drive in self.drives if drive.path in trial_settings().curved]
        if self.against or not curved:
            return None
        v, omega = np.max([np.abs(drive.run.reference_twist).max(axis=0) for drive in curved], axis=0)
        largest, arrived = np.max(_errors(curved), axis=0), _errors(self.unexplained)
        if arrived:
            largest = np.maximum(largest, trial_settings().promise_factor * gmean(arrived))
        lateral, position = (math.ceil(1000 * size) / 1000 for size in largest)
        count = len(self.unexplained)
        share = f"{len(arrived)} of {count}" if len(arrived) < count else "95 of 100"
        return Promise(float(v), float(omega), lateral, position, share)

    @property
    def promise(self) -> str:
        """The same in a sentence without a full stop; empty where nothing drives."""
        promised = self.promised
        if promised is None:
            return ""
        v, omega, lateral, position, share = promised
        return (
            f"follows curved paths at up to {v:.2g} m/s and {omega:.2g} rad/s in {share} drives within "
            f"{100 * lateral:.3g} cm of the path and {100 * position:.3g} cm of the timed position"
        )

    def as_json(self) -> dict[str, Any]:
        """Grade, reasons and promise for a program."""
        return {"grade": self.grade, "reasons": list(self.reasons), "promise": self.promise}

    def answers(self) -> list[str]:
        """Answer whether the robot may drive, how fast, how well, and the next step: a sentence or two each."""
        fit = self.identification.report.fitted.validation.fit_percent
        each = ", ".join(f"{channel} {value:.0f} %" for channel, value in zip(CHANNELS, fit, strict=True))
        explained = f"FIT on data held out: {each}."
        why = f": {'; '.join(self.reasons)}" if self.reasons else " at the speeds and on the floor of the log"
        fast = f"In trial drives in simulation it {self.promise}." if self.promise else "Not at all."
        if self.promise and self.grade == "Yes":
            following = "In simulation with this, then on the robot as report.md ends:"
        elif self.promise:
            following = "Read report.md's warnings, then drive slowly, in simulation first:"
        else:
            following = "report.md says what to mend."
        return [f"{self.grade}{why}.", fast, explained, following]

    def lines(self, folder: Path = Path()) -> list[str]:
        """Return the limits of the base, and the answers in at most ten lines of 80 columns, with the next command."""
        driven, *others = self.answers()
        answers = (_shortened(driven, 3), *others)
        lines = [line for head, words in zip(_HEADS, answers, strict=True) for line in _answer(head, words)]
        limits = [line for words in self.identification.report.limits for line in _answer("Limits", words)]
        return [*limits, *lines, *(next_command(folder) if self.promise else ())]


def _errors(drives: Sequence[TrialDrive]) -> list[tuple[float, float]]:
    """Return the largest errors [m] of drives that arrive: from the path, and from the timed position."""
    arrived = [drive.metrics for drive in drives if drive.metrics.completed]
    return [(metrics.lateral_max_m, metrics.position_max_m) for metrics in arrived]


def _answer(head: str, words: str) -> list[str]:
    indent = " " * (max(map(len, _HEADS)) + 1)
    return textwrap.wrap(words, _WIDTH, initial_indent=head.ljust(len(indent)), subsequent_indent=indent)


def _shortened(words: str, lines: int) -> str:
    """Shorten an answer to `lines`."""
    room = lines * (_WIDTH - max(map(len, _HEADS)) - 8)
    return words if len(words) <= room else f"{words[:room].rsplit(' ', 1)[0]} ... (report.md)"


def next_command(folder: Path = Path()) -> list[str]:
    """Return the command that drives the first path of the trials again, with the files of an identification."""
    options = [
        ["diffdrive-mpc", "simulate", "--config", str(folder / CONFIG_FILE)],
        ["--plant", f"model:{folder / MODEL_FILE}"],
        ["--surface", str(folder / SURFACE_FILE), "--scale-to-robot"],
    ]
    return textwrap.indent(" \\\n  ".join(map(shlex.join, options)), "  ").splitlines()


def judge_by_drives(
    identification: Identification,
    on_try: Callable[[str], None] = lambda _: None,
    on_run: Callable[[], None] = lambda: None,
    *,
    force: bool = False,
) -> TrialVerdict:
    """Drive with the configuration; where drives fail, lower its limits, then simplify its model, until all pass.

    Parameters
    ----------
    identification
        The identification to judge.
    on_try
        Called before the drives of a configuration, with which it is.
    on_run
        Called after each drive.
    force
        Whether the configuration is kept as identified, independent of the drives.

    Raises
    ------
    OSError
        If the files of a configuration cannot be written for its drives.
    """
    plants = stand_ins(identification)
    on_try("driving")
    first = _driven(identification, plants, on_run, whole=True)
    if force or not first.against:
        return _with_unexplained(first, on_try, on_run)
    slower = _fastest(identification, plants, (), on_try, on_run)
    if slower is None and (simpler := _simplified(identification)) is not None:
        candidate, simplified = simpler
        slower = _fastest(candidate, stand_ins(candidate), simplified, on_try, on_run)
    return _with_unexplained(slower or first, on_try, on_run)


def _with_unexplained(verdict: TrialVerdict, on_try: Callable[[str], None], on_run: Callable[[], None]) -> TrialVerdict:
    """Drive curved paths with the motion that the model leaves unexplained; a share of the drives must arrive."""
    identification, settings, drives = verdict.identification, trial_settings(), list[TrialDrive]()
    robot = None if verdict.config is None else identified_robot(identification, verdict.config)
    if verdict.against or verdict.config is None or robot is None:
        return verdict
    on_try("driving with unexplained motion")
    rough = replace(model_itself(identification), name=UNEXPLAINED, slip=robot.slip, sensors=robot.sensors)
    for seed in range(settings.unexplained):
        disturbance = robot.disturbance(verdict.config.sample_time, np.random.default_rng(seed))
        plant = replace(rough, disturbance=disturbance)
        path = settings.curved[seed % len(settings.curved)]
        drives += trial_drives(identification, verdict.config, [plant], on_run, paths=[path], seed=seed)
    proven = replace(verdict, unexplained=tuple(drives), robot=robot)
    lost = sum(not drive.metrics.completed for drive in drives)
    return replace(proven, against=proven._rough[0]) if lost > settings.lost_share * len(drives) else proven


def _fastest(
    candidate: Identification,
    plants: Sequence[StandIn],
    simplified: tuple[str, ...],
    on_try: Callable[[str], None],
    on_run: Callable[[], None],
) -> TrialVerdict | None:
    """Find the largest configured share of the limits whose drives pass, by bisection; None if the least fails."""
    shares = trial_settings().shares

    def attempt(i: int) -> TrialVerdict:
        lowered, words = _lowered(candidate, shares[i])
        on_try(", ".join(["driving", *simplified, *words]))
        return replace(_driven(lowered, plants, on_run, whole=False), changed=(*simplified, *words))

    fails, passes = -1, len(shares) - 1
    best = attempt(passes)
    if best.against:
        return None
    while passes - fails > 1:
        middle = (fails + passes) // 2
        tried = attempt(middle)
        fails, passes = (middle, passes) if tried.against else (fails, middle)
        best = best if tried.against else tried
    return best


def _simplified(identification: Identification) -> tuple[Identification, tuple[str, ...]] | None:
    """Return the plain SM of the same data and the changes; None if it is one already, or there is none."""
    report = identification.report
    fitted = report.fitted
    if fitted.structure == SIMPLEST and fitted.base is None:
        return None
    try:
        simpler = identify_data(report.data, STRUCTURES[SIMPLEST], report.name)
    except ValueError:
        return None
    more = " with effects" if fitted.base is not None else ""
    words = f"a plain {SIMPLEST.upper()} in place of the {fitted.structure.upper()}{more}, which fails"
    return None if simpler.refusal else (simpler, (words,))


def _lowered(identification: Identification, shares: tuple[float, float]) -> tuple[Identification, tuple[str, ...]]:
    """Reduce the limits of v and omega to a share; return the identification with the changes."""
    configuration = identification.configuration.slowed(dict(zip(CHANNELS, shares, strict=True)))
    words = [
        f"limits.{channel} lowered to {100 * share:.0f} %, as faster trial drives fail"
        for channel, share in zip(CHANNELS, shares, strict=True)
        if share < 1.0
    ]
    return replace(identification, configuration=configuration, config=configuration.mapping()), tuple(words)


def _driven(
    identification: Identification, plants: Sequence[StandIn], on_run: Callable[[], None], *, whole: bool
) -> TrialVerdict:
    """Run the trial drives of a configuration; stop after the first failure unless `whole`."""
    drives: list[TrialDrive] = []
    config: ControllerConfig | None = None
    with TemporaryDirectory() as folder:
        identification.write_model(folder)
        try:
            config = load_config(Path(folder) / CONFIG_FILE)
            for drive in trial_drives(identification, config, plants, on_run):
                drives.append(drive)
                if not (drive.passed or whole):
                    break
        except ValueError as error:
            return TrialVerdict(identification, config, (), against=f"the configuration does not drive: {error}")
    failed = trial_doubts(drives)
    more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
    return TrialVerdict(identification, config, tuple(drives), against=f"{failed[0].words}{more}" if failed else "")
