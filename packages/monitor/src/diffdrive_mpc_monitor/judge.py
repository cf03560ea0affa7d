"""The judge for Python: its inputs, and its verdict in words."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cffi

from diffdrive_mpc.models.compiled.compiler import digest_of
from diffdrive_mpc.models.compiled.packaged import BASELINE, Level, Packaged
from diffdrive_mpc_monitor.rules import Rules

# The judge through cffi; `core/judge.h` describes it.


CORE = Path(__file__).parent / "core"
"""Folder of the C file and its header."""
SOURCES = ("judge.c", "judge.h")

# The same bits on every processor: decisions of the monitor of a microcontroller can be repeated on a PC.
_FLAGS = ("-ffp-contract=off",)


@cache
def load_judge() -> tuple[cffi.FFI, Any]:
    """Load the judge: cffi's declarations of `judge.h`, and the library.

    Raises
    ------
    NotCompiledError
        If the package brought no library, and none can be compiled.
    """
    header = re.sub(r"^\s*#.*$", "", source_texts()["judge.h"], flags=re.MULTILINE)
    declarations = header.replace("DDMON_EXPORT ", "")
    complaint = "the monitor's judge is not compiled: {}, which holds it"
    return _packaged().load(source_texts(), declarations, complaint)


def write_packaged(folder: Path) -> list[Path]:
    """Compile the judge for the package in `folder`: library and manifest.

    Raises
    ------
    NotCompiledError
        If it cannot be compiled.
    """
    return _packaged().write(source_texts(), folder)


def source_texts() -> dict[str, str]:
    """Return the text of each source by its name."""
    return {name: (CORE / name).read_text(encoding="utf-8") for name in SOURCES}


def _packaged() -> Packaged:
    origin = digest_of([*source_texts().values(), *_FLAGS])
    return Packaged("ddmpc_monitor", CORE, origin, {BASELINE: Level(_FLAGS, frozenset())})


_SIZES = ("DDMON_RULES", "DDMON_COMMANDS", "DDMON_TRACK", "DDMON_POSES")


class MonitorVerdict(NamedTuple):
    """Verdict: the first broken rule, its time and its figures.

    Attributes
    ----------
    rule
        Name of the rule, such as "off_path"; empty without a violation.
    at
        Time of the verdict [s].
    words
        A sentence for a person; empty where all is well.
    """

    rule: str
    at: float
    words: str

    def __bool__(self) -> bool:
        """Return True if a rule is broken."""
        return bool(self.rule)


class Judge:
    """Checks commands and sensors, and decides whether commands pass. Times are seconds that never go back.

    Parameters
    ----------
    rules
        Rules to check.
    now
        Start time [s].

    Raises
    ------
    models.compiled.compiler.NotCompiledError
        If its C is not there and cannot be compiled.
    """

    def __init__(self, rules: Rules, now: float = 0.0) -> None:
        self.rules = rules
        self._ffi, self._lib = load_judge()
        self._rules = self._ffi.new("ddmon_rules *", rules.numbers)
        self._judge = self._ffi.new("ddmon_judge *")
        self._out = self._ffi.new("double[2]")
        self._path = self._ffi.new("ddmon_point[]", 1)
        self._lib.ddmon_init(self._judge, self._rules, now)

    @property
    def verdict(self) -> MonitorVerdict:
        """The rule that stopped the robot."""
        return self._said(self._judge.verdict)

    def reference(self, now: float, points: Sequence[Sequence[float]]) -> bool:
        """Take a reference: (n, 4) when [s], x [m], y [m], theta [rad]; whether it can be followed. Empty: none."""
        # The judge's reference exists as long as the judge; the old one until it has the new one.
        path = self._ffi.new("ddmon_point[]", [tuple(map(float, point)) for point in points] or 1)
        sound = bool(self._lib.ddmon_reference(self._judge, now, path, len(points)))
        self._path = path
        return sound

    def odometry(self, now: float, stamp: float, twist: Sequence[float], pose: Sequence[float]) -> None:
        """Take odometry of `stamp` [s]: (2,) v [m/s], omega [rad/s], (3,) x [m], y [m], theta [rad]."""
        self._lib.ddmon_odometry(self._judge, now, stamp, *twist, *pose)

    def gyro(self, now: float, stamp: float, yaw_rate: float) -> None:
        """Take a yaw rate [rad/s] of `stamp` [s]."""
        self._lib.ddmon_gyro(self._judge, now, stamp, yaw_rate)

    def pose(self, now: float, stamp: float, pose: Sequence[float]) -> None:
        """Take a pose of `stamp` [s] in the frame of the reference: (3,) x [m], y [m], theta [rad]."""
        self._lib.ddmon_pose(self._judge, now, stamp, *pose)

    def says(self, now: float, *, drives: bool) -> None:
        """Take the controller's word, whether it drives."""
        self._lib.ddmon_says(self._judge, now, drives)

    def outside(self, now: float, *, wrong: bool) -> None:
        """Record whether another node commands the base."""
        self._lib.ddmon_outside(self._judge, now, wrong)

    def command(self, now: float, stamp: float, v: float, omega: float) -> tuple[float, float]:
        """Judge a command v [m/s], omega [rad/s] and return the one for the base; `stamp` [s] is 0 without one."""
        self._lib.ddmon_command(self._judge, now, stamp, v, omega, self._out)
        return self._out[0], self._out[1]

    def tick(self, now: float) -> tuple[float, float] | None:
        """Update the time; return the command for the base where the robot was stopped, else None."""
        if not self._lib.ddmon_tick(self._judge, now, self._out):
            return None
        return self._out[0], self._out[1]

    def reset(self, now: float) -> MonitorVerdict:
        """Resume if all rules hold, the robot stands and no other node moves it; return the verdict.

        A robot that is off its path continues without a reference: the controller must start again.
        """
        return self._said(self._lib.ddmon_reset(self._judge, now))

    def _said(self, verdict: object) -> MonitorVerdict:
        number, time, value, limit = (getattr(verdict, name) for name in ("rule", "at", "value", "limit"))
        if not number:
            return MonitorVerdict("", time, "")
        words, unit = (self._text(function, number) for function in ("ddmon_words", "ddmon_unit"))
        figures = f": {value:.3g} {unit}, the limit is {limit:.3g} {unit}" if unit else ""
        return MonitorVerdict(rule_names()[number], time, f"{words}{figures}")

    def _text(self, function: str, number: int) -> str:
        return bytes(self._ffi.string(getattr(self._lib, function)(number))).decode("ascii")


@cache
def rule_names() -> tuple[str, ...]:
    """Return the names of the rules by number; the first is empty."""
    _, lib = load_judge()
    names = [name for name in dir(lib) if name.startswith("DDMON_") and name.isupper()]
    numbers = {getattr(lib, name): name for name in names if name not in _SIZES}
    return ("", *(numbers[k].removeprefix("DDMON_").lower() for k in range(1, lib.DDMON_RULES)))
