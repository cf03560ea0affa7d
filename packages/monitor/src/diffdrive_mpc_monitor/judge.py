"""Python interface of the judge, with verdicts as text."""

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

# Library of the judge through cffi; see `core/judge.h`.


CORE = Path(__file__).parent / "core"
"""Folder of the C source and its header."""
SOURCES = ("judge.c", "judge.h")

# Without contraction, decisions of a microcontroller can be reproduced on a PC bit by bit.
_FLAGS = ("-ffp-contract=off",)


@cache
def load_judge() -> tuple[cffi.FFI, Any]:
    """Load the cffi declarations of `judge.h`, and the library.

    Raises
    ------
    NotCompiledError
        If the package contains no library and it cannot be compiled.
    """
    header = re.sub(r"^\s*#.*$", "", source_texts()["judge.h"], flags=re.MULTILINE)
    declarations = header.replace("DDMON_EXPORT ", "")
    complaint = "the monitor's judge is not compiled: {}, which contains it"
    return _packaged().load(source_texts(), declarations, complaint)


def write_packaged(folder: Path) -> list[Path]:
    """Compile the judge for the package, and write library and manifest into `folder`.

    Raises
    ------
    NotCompiledError
        If the compilation fails.
    """
    return _packaged().write(source_texts(), folder)


def source_texts() -> dict[str, str]:
    """Return the text of each source file by name."""
    return {name: (CORE / name).read_text(encoding="utf-8") for name in SOURCES}


def _packaged() -> Packaged:
    origin = digest_of([*source_texts().values(), *_FLAGS])
    return Packaged("ddmpc_monitor", CORE, origin, {BASELINE: Level(_FLAGS, frozenset())})


_SIZES = ("DDMON_RULES", "DDMON_COMMANDS", "DDMON_TRACK", "DDMON_POSES")


class MonitorVerdict(NamedTuple):
    """Verdict: the first violated rule, with its time and a description.

    Attributes
    ----------
    rule
        Name of the rule, such as "off_path"; empty without a violation.
    at
        Time of the verdict [s].
    words
        Description of the violation; empty if all rules hold.
    """

    rule: str
    at: float
    words: str

    def __bool__(self) -> bool:
        """Return True if a rule is violated."""
        return bool(self.rule)


class Judge:
    """Check of commands and sensors that passes or replaces commands. Times are in s and must not decrease.

    Parameters
    ----------
    rules
        Rules to check.
    now
        Start time [s].

    Raises
    ------
    models.compiled.compiler.NotCompiledError
        If the library is missing and cannot be compiled.
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
        """Verdict with the rule that stopped the robot."""
        return self._make_verdict(self._judge.verdict)

    def reference(self, now: float, points: Sequence[Sequence[float]]) -> bool:
        """Set the reference (n, 4): time [s], x [m], y [m], theta [rad]; empty for none. Return True if it is valid."""
        # The memory of a reference must live until the judge has the next one.
        path = self._ffi.new("ddmon_point[]", [tuple(map(float, point)) for point in points] or 1)
        is_valid = bool(self._lib.ddmon_reference(self._judge, now, path, len(points)))
        self._path = path
        return is_valid

    def odometry(self, now: float, stamp: float, twist: Sequence[float], pose: Sequence[float]) -> None:
        """Add odometry with `stamp` [s]: twist (2,) v [m/s], omega [rad/s], and pose (3,) x [m], y [m], theta [rad]."""
        self._lib.ddmon_odometry(self._judge, now, stamp, *twist, *pose)

    def gyro(self, now: float, stamp: float, yaw_rate: float) -> None:
        """Add a yaw rate of the gyro [rad/s] with `stamp` [s]."""
        self._lib.ddmon_gyro(self._judge, now, stamp, yaw_rate)

    def pose(self, now: float, stamp: float, pose: Sequence[float]) -> None:
        """Add a pose with `stamp` [s] in the frame of the reference: (3,) x [m], y [m], theta [rad]."""
        self._lib.ddmon_pose(self._judge, now, stamp, *pose)

    def says(self, now: float, *, drives: bool) -> None:
        """Set the state that the controller reports: True if it drives."""
        self._lib.ddmon_says(self._judge, now, drives)

    def outside(self, now: float, *, wrong: bool) -> None:
        """Set or clear the fault that another node commands the base."""
        self._lib.ddmon_outside(self._judge, now, wrong)

    def command(self, now: float, stamp: float, v: float, omega: float) -> tuple[float, float]:
        """Check a command v [m/s], omega [rad/s] and return the command for the base; `stamp` [s] is 0 if missing."""
        self._lib.ddmon_command(self._judge, now, stamp, v, omega, self._out)
        return self._out[0], self._out[1]

    def tick(self, now: float) -> tuple[float, float] | None:
        """Update the time; return the command for the base if the monitor has stopped the robot, else None."""
        if not self._lib.ddmon_tick(self._judge, now, self._out):
            return None
        return self._out[0], self._out[1]

    def reset(self, now: float) -> MonitorVerdict:
        """Resume if all rules hold, the robot stands and no command moves it; return the verdict.

        A robot that is far from its path loses its reference, so the controller must start again.
        """
        return self._make_verdict(self._lib.ddmon_reset(self._judge, now))

    def _make_verdict(self, verdict: object) -> MonitorVerdict:
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
