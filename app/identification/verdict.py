"""Verdict on an identified model, based on the quality of its logs and on trial drives."""

from __future__ import annotations

import math
import shlex
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
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
from diffdrive_mpc.models.checked_yaml import read_yaml
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
_DRIVES = 2 * len(PATHS)
"""Number of trial drives of one configuration without unexplained motion."""


class Promise(NamedTuple):
    """Expected performance: maximum speeds on curved paths, and errors that a share of the drives does not exceed."""

    v: float
    """Maximum speed [m/s]."""
    omega: float
    """Maximum yaw rate [rad/s]."""
    lateral: float
    """Maximum distance from the path [m]."""
    position: float
    """Maximum distance from the position of the reference at the same time [m]."""
    share: str
    """Share of drives within these errors: "95 of 100", or the share of drives that arrive if some do not."""


@dataclass(frozen=True)
class TrialVerdict:
    """Identification with the trial drives of its configuration.

    Attributes
    ----------
    identification
        Identification, with lower limits or a simpler model if drives with the original configuration failed.
    config
        Configuration of the identified robot; None if the configuration is invalid.
    drives
        Trial drives with the configuration.
    changes
        Reductions of limits and simplifications with which the drives pass, as clauses.
    failure
        Reason why the configuration is unusable, as a clause; empty if the drives pass.
    unexplained
        Drives on curved paths with the unexplained motion of the validation data.
    robot
        Robot with unexplained motion; None if there are no such drives.
    """

    identification: Identification
    config: ControllerConfig | None
    drives: tuple[TrialDrive, ...]
    changes: tuple[str, ...] = ()
    failure: str = ""
    unexplained: tuple[TrialDrive, ...] = ()
    robot: IdentifiedRobot | None = None

    @property
    def grade(self) -> Grade:
        """Grade of the model for driving."""
        trust = self.identification.report.trust
        if self.failure or trust.grade == "No":
            return "No"
        return "With care" if self.reasons else "Yes"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons against a better grade, as clauses."""
        trust = self.identification.report.trust
        if self.failure:
            return (self.failure,)
        has_no_stand_in = self.drives and not any(drive.plant == HELD_OUT for drive in self.drives)
        held_out = f"{self.identification.report.data.held_out} do not determine a held-out model"
        missing = (f"{held_out}: record steps of both signs in v and in omega there, too",) if has_no_stand_in else ()
        return (*self.changes, *missing, *self._unexplained_reasons, *trust.reasons)

    @property
    def _lost(self) -> int:
        """Number of drives with unexplained motion that do not arrive."""
        return len(self.unexplained) - len(_errors(self.unexplained))

    @property
    def _unexplained_reasons(self) -> tuple[str, ...]:
        if self._lost:
            return (f"{self._lost} of {len(self.unexplained)} drives of {UNEXPLAINED} do not arrive",)
        if all(drive.passed for drive in self.unexplained):
            return ()
        return (f"{UNEXPLAINED} leaves its path by more than {100 * trial_settings().lateral_share:g} % of a radius",)

    @property
    def performance(self) -> Promise | None:
        """Expected performance of the robot; None if the configuration is unusable."""
        curved = [drive for drive in self.drives if drive.path in trial_settings().curved]
        if self.failure or not curved:
            return None
        v, omega = np.max([np.abs(drive.run.reference_twist).max(axis=0) for drive in curved], axis=0)
        max_errors, arrived = np.max(_errors(curved), axis=0), _errors(self.unexplained)
        if arrived:
            max_errors = np.maximum(max_errors, trial_settings().promise_factor * gmean(arrived))
        lateral, position = (math.ceil(1000 * error) / 1000 for error in max_errors)
        share = f"{len(arrived)} of {len(self.unexplained)}" if self._lost else "95 of 100"
        return Promise(float(v), float(omega), lateral, position, share)

    @property
    def promise(self) -> str:
        """Expected performance as a sentence without a full stop; empty if the configuration is unusable."""
        if (performance := self.performance) is None:
            return ""
        v, omega, lateral, position, share = performance
        return (
            f"follows curved paths at up to {v:.2g} m/s and {omega:.2g} rad/s in {share} drives within "
            f"{100 * lateral:.3g} cm of the path and {100 * position:.3g} cm of the timed position"
        )

    def as_json(self) -> dict[str, Any]:
        """Return grade, reasons and promise for JSON."""
        return {"grade": self.grade, "reasons": list(self.reasons), "promise": self.promise}

    def conclusions(self) -> list[str]:
        """Return four sentences: permission to drive, trial drives, quality of the model, and next step."""
        fit = self.identification.report.fitted.validation.fit_percent
        values = ", ".join(f"{channel} {value:.0f} %" for channel, value in zip(CHANNELS, fit, strict=True))
        quality = f"FIT on held-out data: {values}."
        reasons = f": {'; '.join(self.reasons)}" if self.reasons else " at the speeds and on the surface of the log"
        drives = f"drives of {UNEXPLAINED}" if self.unexplained else "trial drives"
        fast = f"In simulated {drives} it {self.promise}." if self.promise else "Not at all."
        if self.promise and self.grade == "Yes":
            next_step = "Simulate with this command, then drive the robot as described at the end of report.md:"
        elif self.promise:
            next_step = "Read the warnings in report.md, then drive slowly, first in simulation:"
        else:
            remedy = _remedy(self.identification)
            next_step = f"{remedy[0].upper()}{remedy[1:]}."
        return [f"{self.grade}{reasons}.", fast, quality, next_step]

    def headed_conclusions(self) -> list[str]:
        """Return the conclusions with their headings; the last one includes the next command."""
        command = " ".join(line.strip(" \\") for line in next_command()) if self.promise else ""
        texts = [f"{head} {text}" for head, text in zip(_HEADS, self.conclusions(), strict=True)]
        return [*texts[:-1], f"{texts[-1]} {command}".strip()]

    def lines(self, folder: Path = Path()) -> list[str]:
        """Format limits of the base, conclusions and next command in lines of 80 columns."""
        permission, *others = self.conclusions()
        conclusions = (_shortened(permission, 3), *others)
        lines = [line for head, text in zip(_HEADS, conclusions, strict=True) for line in _wrap(head, text)]
        limits = [line for text in self.identification.report.limits for line in _wrap("Limits", text)]
        return [*limits, *lines, *(next_command(folder) if self.promise else ())]


@cache
def remedies() -> dict[str, str]:
    """Load `remedies.yaml`: remedies by kind of warning."""
    texts: dict[str, str] = read_yaml(Path(__file__).with_name("remedies.yaml"))
    return texts


def _remedy(identification: Identification) -> str:
    """Return the next step without a usable configuration as a clause; it names the warnings only if they help."""
    report = identification.report
    speed = 0.5 * max(np.abs(record.command[:, 0]).max() for record in report.data.train)
    slower = f"record slower drives, with v up to {speed:.2g} m/s"
    is_curable = any(not remedies()[item.kind].startswith("no action") for item in report.objections)
    return f"correct the causes of the warnings in report.md, or {slower}" if is_curable else slower


def _errors(drives: Sequence[TrialDrive]) -> list[tuple[float, float]]:
    """Return the maximum lateral and position errors [m] of the drives that arrive."""
    arrived = [drive.metrics for drive in drives if drive.metrics.completed]
    return [(metrics.lateral_max_m, metrics.position_max_m) for metrics in arrived]


def _wrap(head: str, text: str) -> list[str]:
    indent = " " * (max(map(len, _HEADS)) + 1)
    return textwrap.wrap(text, _WIDTH, initial_indent=head.ljust(len(indent)), subsequent_indent=indent)


def _shortened(text: str, lines: int) -> str:
    """Shorten a conclusion to `lines` lines."""
    max_length = lines * (_WIDTH - max(map(len, _HEADS)) - 8)
    return text if len(text) <= max_length else f"{text[:max_length].rsplit(' ', 1)[0]} ... (report.md)"


def next_command(folder: Path = Path()) -> list[str]:
    """Format the command that repeats the first trial drive with the files of an identification."""
    options = [
        ["diffdrive-mpc", "simulate", "--config", str(folder / CONFIG_FILE)],
        ["--plant", f"model:{folder / MODEL_FILE}"],
        ["--surface", str(folder / SURFACE_FILE), "--scale-to-robot"],
    ]
    return textwrap.indent(" \\\n  ".join(map(shlex.join, options)), "  ").splitlines()


def judge_by_drives(
    identification: Identification,
    on_try: Callable[[str, int], None] = lambda *_: None,
    on_run: Callable[[], None] = lambda: None,
    *,
    force: bool = False,
) -> TrialVerdict:
    """Run trial drives; if drives fail, reduce the limits of the configuration, then simplify its model.

    Parameters
    ----------
    identification
        Identification to assess.
    on_try
        Function that is called before the drives of a configuration, with its description and the number of drives.
    on_run
        Function that is called after each drive.
    force
        True to keep the identified configuration even if drives fail.

    Raises
    ------
    OSError
        If the temporary files of a configuration cannot be written.
    """
    plants = stand_ins(identification)
    on_try("driving", _DRIVES)
    first = _run_drives(identification, plants, on_run, run_all=True)
    if force or not first.failure:
        return _with_unexplained(first, on_try, on_run)
    reduced = _with_fastest_limits(identification, plants, (), on_try, on_run)
    if reduced is None and (simpler := _simpler_model(identification)) is not None:
        candidate, changes = simpler
        reduced = _with_fastest_limits(candidate, stand_ins(candidate), changes, on_try, on_run)
    if reduced is None:
        lowest = f"{100 * trial_settings().shares[-1][0]:.0f} % of the limits"
        return replace(first, failure=f"{first.failure}, also with {lowest}")
    return _with_unexplained(reduced, on_try, on_run)


def _with_unexplained(
    verdict: TrialVerdict, on_try: Callable[[str, int], None], on_run: Callable[[], None]
) -> TrialVerdict:
    """Run drives on curved paths with unexplained motion, and add them to the verdict; most drives must arrive."""
    identification, settings, drives = verdict.identification, trial_settings(), list[TrialDrive]()
    if verdict.failure or verdict.config is None or (robot := identified_robot(identification, verdict.config)) is None:
        return verdict
    on_try("driving with unexplained motion", settings.unexplained)
    stand_in = replace(model_itself(identification), name=UNEXPLAINED, slip=robot.slip, sensors=robot.sensors)
    for seed in range(settings.unexplained):
        disturbance = robot.disturbance(verdict.config.sample_time, np.random.default_rng(seed))
        path, plant = settings.curved[seed % len(settings.curved)], replace(stand_in, disturbance=disturbance)
        drives += trial_drives(identification, verdict.config, [plant], on_run, paths=[path], seed=seed)
    result = replace(verdict, unexplained=tuple(drives), robot=robot)
    share = gmean([drive.lateral_share for drive in drives])
    is_lost = result._lost > settings.lost_share * len(drives)
    distance = f"{UNEXPLAINED} leaves its path by {100 * share:.0f} % of a radius on average"
    # Lower limits hardly help: the part of the motion that does not depend on the speed has more time to act.
    failure = f"{result._unexplained_reasons[0] if is_lost else distance}: {_remedy(identification)}"
    return replace(result, failure=failure) if is_lost or share > settings.mean_share else result


def _with_fastest_limits(
    candidate: Identification,
    plants: Sequence[StandIn],
    changes: tuple[str, ...],
    on_try: Callable[[str, int], None],
    on_run: Callable[[], None],
) -> TrialVerdict | None:
    """Find the largest shares of the limits with which the drives pass, by bisection; None if the smallest fail."""
    shares = trial_settings().shares

    def attempt(i: int) -> TrialVerdict:
        reduced, reductions = _with_reduced_limits(candidate, shares[i])
        on_try(", ".join(["driving", *changes, *reductions]), _DRIVES)
        return replace(_run_drives(reduced, plants, on_run, run_all=False), changes=(*changes, *reductions))

    failing, passing = -1, len(shares) - 1
    best = attempt(passing)
    if best.failure:
        return None
    while passing - failing > 1:
        middle = (failing + passing) // 2
        verdict = attempt(middle)
        failing, passing = (middle, passing) if verdict.failure else (failing, middle)
        best = best if verdict.failure else verdict
    return best


def _simpler_model(identification: Identification) -> tuple[Identification, tuple[str, ...]] | None:
    """Identify a plain SM from the data; return it with the change, or None if it is not simpler or cannot be used."""
    report = identification.report
    fitted = report.fitted
    if fitted.structure == SIMPLEST and fitted.base is None:
        return None
    try:
        simpler = identify_data(report.data, STRUCTURES[SIMPLEST], report.name)
    except ValueError:
        return None
    effects = " with effects" if fitted.base is not None else ""
    change = f"a plain {SIMPLEST.upper()} instead of the {fitted.structure.upper()}{effects}, which fails"
    return None if simpler.refusal else (simpler, (change,))


def _with_reduced_limits(
    identification: Identification, shares: tuple[float, float]
) -> tuple[Identification, tuple[str, ...]]:
    """Reduce the limits of v and omega to `shares`; return the identification and the changes."""
    configuration = identification.configuration.slowed(dict(zip(CHANNELS, shares, strict=True)))
    changes = [
        f"limits.{channel} reduced to {100 * share:.0f} %, because faster trial drives fail"
        for channel, share in zip(CHANNELS, shares, strict=True)
        if share < 1.0
    ]
    return replace(identification, configuration=configuration, config=configuration.mapping()), tuple(changes)


def _run_drives(
    identification: Identification, plants: Sequence[StandIn], on_run: Callable[[], None], *, run_all: bool
) -> TrialVerdict:
    """Run the trial drives of a configuration; stop after the first failure unless `run_all`."""
    drives: list[TrialDrive] = []
    config: ControllerConfig | None = None
    with TemporaryDirectory() as folder:
        identification.write_model(folder)
        try:
            config = load_config(Path(folder) / CONFIG_FILE)
            for drive in trial_drives(identification, config, plants, on_run):
                drives.append(drive)
                if not (drive.passed or run_all):
                    break
        except ValueError as error:
            return TrialVerdict(identification, config, (), failure=f"the configuration is unusable: {error}")
    failed = trial_doubts(drives)
    more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
    return TrialVerdict(identification, config, tuple(drives), failure=f"{failed[0].message}{more}" if failed else "")
