"""The monitor's judge: whatever it is told, what it passes on is finite and inside its rules, and a stop stays one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from random import Random
from typing import Any

from diffdrive_mpc_monitor.judge import Judge
from diffdrive_mpc_monitor.rules import load_rules
from fuzz import odd, shrink
from fuzz.case import Case, FaultError

_PERIOD = 0.02


class MonitorFuzzer:
    """Commands, sensors, references, resets and clocks, mostly those of a sound drive, in any order."""

    name, longest, count = "monitor", 20.0, 300

    def draw(self, random: Random) -> Case:
        """What the judge is told, one thing upon the other."""
        events: list[list[Any]] = [["drive", random.choice((1, 10, 60))]]
        for _ in range(random.choice((1, 5, 30))):
            events += [_draw_event(random), ["drive", random.choice((0, 1, 2, 20))]]
        return events

    def check(self, case: Case) -> None:
        """Tell it all that."""
        watched = _Watched()
        for kind, *given in case:
            getattr(watched, kind)(*given)

    def simpler(self, case: Case) -> Iterator[Case]:
        """Fewer events, plainer numbers."""
        yield from shrink.fewer(case)
        yield from shrink.plainer(case)


class _Watched:
    """A judge in front of a robot that does what gets through."""

    def __init__(self) -> None:
        self.rules = load_rules()
        self.now, self.pose, self.sent = 0.0, [0.0, 0.0, 0.0], (0.0, 0.0)
        self.judge = Judge(self.rules, self.now)
        self.stopped = False
        self.plain_reference()

    def plain_reference(self) -> None:
        """Straight on from where it is, at 0.3 m/s."""
        x, y, theta = self.pose
        c, s = math.cos(theta), math.sin(theta)
        line = [(self.now + 0.1 * i, x + 0.03 * c * i, y + 0.03 * s * i, theta) for i in range(100)]
        self.judge.reference(self.now, line)

    def drive(self, count: int) -> None:
        """Sound sensors and commands."""
        for _ in range(count):
            self.now += _PERIOD
            v, omega = self.sent
            self.pose[0] += _PERIOD * v * math.cos(self.pose[2])
            self.pose[1] += _PERIOD * v * math.sin(self.pose[2])
            self.pose[2] += _PERIOD * omega
            self.judge.odometry(self.now, self.now, self.sent, self.pose)
            self.judge.gyro(self.now, self.now, omega)
            self.judge.pose(self.now, self.now, self.pose)
            self.judge.says(self.now, drives=True)
            self.command(0.0, 0.0, min(0.3, self.sent[0] + 0.01), 0.0)
            self.tick(0.0)

    def command(self, later: float, stamp: float, v: float, omega: float) -> None:
        """A command, at a time and with a stamp that may be odd."""
        self._sent(self.judge.command(self.now + later, self.now + stamp, v, omega))

    def tick(self, later: float) -> None:
        """Time passes."""
        out = self.judge.tick(self.now + later)
        if out is not None:
            self._sent(out)

    def told(self, what: str, stamp: float, numbers: list[float]) -> None:
        """A sensor says something odd."""
        a, b, c = numbers
        if what == "odometry":
            self.judge.odometry(self.now, self.now + stamp, (a, b), (*self.pose[:2], c))
        elif what == "gyro":
            self.judge.gyro(self.now, self.now + stamp, a)
        else:
            self.judge.pose(self.now, self.now + stamp, numbers)

    def reference(self, points: list[list[float]]) -> None:
        """A reference of any kind."""
        self.judge.reference(self.now, points)

    def says(self, drives: bool, wrong: bool) -> None:
        """What the controller says, and whether somebody else commands."""
        self.judge.says(self.now, drives=drives)
        self.judge.outside(self.now, wrong=wrong)

    def reset(self, later: float, fresh: bool) -> None:
        """Go on, if it may."""
        if fresh:
            self.plain_reference()
        if not self.judge.reset(self.now + later):
            self.stopped = False

    def _sent(self, out: tuple[float, float]) -> None:
        commands, verdict = self.rules.commands, self.judge.verdict
        said = f"{out} after {self.sent}, {verdict}"
        if not all(map(math.isfinite, out)):
            raise FaultError(f"not finite: {said}")
        if abs(out[0]) > commands.v * (1 + 1e-9) or abs(out[1]) > commands.omega * (1 + 1e-9):
            raise FaultError(f"limits: {said}")
        if self.stopped and not verdict:
            raise FaultError(f"latch: it let go by itself: {said}")
        faster = any(abs(now) > abs(was) + 1e-12 for now, was in zip(out, self.sent, strict=True))
        # The command in whose call a rule is found broken may still pass; from the next on it brakes.
        if self.stopped and verdict and faster:
            raise FaultError(f"stop: and speeds up: {said}")
        if verdict and ("\n" in verdict.words or not verdict.words.isprintable()):
            raise FaultError(f"words: cannot be shown: {verdict.words!r}")
        self.stopped, self.sent = bool(verdict), out


def _draw_event(random: Random) -> list[Any]:
    kind = random.choice(("command", "command", "tick", "told", "told", "told", "reference", "says", "reset"))
    later = random.choice((0.0, 0.0, 0.0, 0.01, 0.5, 5.0, -0.02, -5.0, odd.number(random)))
    if kind == "command":
        return [
            kind,
            later,
            random.choice((0.0, -0.3, 1.0, odd.number(random))),
            _some(random, 0.3),
            _some(random, 0.3),
        ]
    if kind == "tick":
        return [kind, later]
    if kind == "told":
        return [kind, random.choice(("odometry", "gyro", "pose")), later, [_some(random, 0.5) for _ in range(3)]]
    if kind == "reference":
        count = random.choice((0, 1, 2, 10, 1000))
        return [kind, [[0.1 * i + _some(random, 0.01), *[_some(random, 1.0) for _ in range(3)]] for i in range(count)]]
    if kind == "says":
        return [kind, random.random() < 0.5, random.random() < 0.2]
    return [kind, later, random.random() < 0.7]


def _some(random: Random, scale: float) -> float:
    return odd.number(random) if random.random() < 0.15 else random.gauss(0.0, scale)
