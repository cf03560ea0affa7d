"""Doubts about a log or a model, and their relevance for driving: one definition for each kind."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from diffdrive_mpc.models.table import escaped


@dataclass(frozen=True)
class DoubtRelevance:
    """Relevance of a kind of doubt for driving with the model.

    Attributes
    ----------
    matters
        Yes or no.
    why
        In few words.
    """

    matters: bool
    why: str

    def __str__(self) -> str:
        """Format the relevance in words."""
        return f"{'matters' if self.matters else 'does not matter'} for driving: {self.why}"


def _yes(why: str) -> DoubtRelevance:
    return DoubtRelevance(True, why)


def _no(why: str) -> DoubtRelevance:
    return DoubtRelevance(False, why)


_ROBOT = _yes("the model would be of no robot")
_SCALE = _yes("a speed would be wrong by a factor")
_SIGN = _yes("the robot would be steered the wrong way")
_LATE = _yes("the dead time would be wrong by as much")
_LEFT_OUT = _no("the rest of the log is used")
_UNKNOWN = _yes("what was not driven is not known")

VERDICTS: Mapping[str, DoubtRelevance] = {
    # Of logs: kinds of `models.logs.Finding`.
    "NaN rows": _LEFT_OUT,
    "time stands still": _LEFT_OUT,
    "time backwards": _LEFT_OUT,
    "two clocks": _LEFT_OUT,
    "two types": _LEFT_OUT,
    "spikes": _LEFT_OUT,
    "stuck sensor": _LEFT_OUT,
    "stretch left out": _LEFT_OUT,
    "silent commands": _LEFT_OUT,
    "jitter": _LATE,
    "clock drift": _LATE,
    "time shift": _LATE,
    "shuffled stamps": _ROBOT,
    "bursty stamps": _ROBOT,
    "different logs": _ROBOT,
    "running counts": _SCALE,
    "wrong unit": _SCALE,
    "scale change": _SCALE,
    "dead wheel": _SCALE,
    "uneven wheels": _SCALE,
    "reversed wheel": _SIGN,
    "swapped sides": _SIGN,
    "mirrored pose": _SIGN,
    "late sensor": _no("`identify` puts it right"),
    "scaled sensor": _no("`identify` puts it right"),
    "turned pose": _yes("where the robot drives would be told beside its path"),
    "order change": _SIGN,
    "dead readings": _SCALE,
    "second publisher": _ROBOT,
    "late wheel": _LATE,
    "tyre change": _yes("the robot would drive a curve where it is told a line"),
    "gyro drift": _yes("the heading would drift as much"),
    "curved command": _yes("the robot would drive small commands slower than the model says"),
    "scaled poses": _yes("lengths in the map are not those on the floor"),
    "slipping wheels": _yes("on another floor the robot would drive much faster than the model says"),
    "gain drift": _yes("the robot may drive faster or slower than the model says"),
    "rectified sensor": _SIGN,
    "clipped sensor": _SCALE,
    "filtered sensor": _LATE,
    "echoed command": _ROBOT,
    "latched command": _ROBOT,
    "rounded command": _SCALE,
    "wrong sign": _SIGN,
    "no response": _ROBOT,
    "weak response": _yes("little of what the robot does is known"),
    "constant input": _UNKNOWN,
    "little excitation": _UNKNOWN,
    "saturation": _yes("beyond its limit the robot may do less than it is told"),
    # Of estimates.
    "second lag": _no("one lag is enough"),
    "divided lag": _no("dead time and lag are right together"),
    "equal lags": _no("together they predict the same"),
    "lag": _yes("how late the robot answers is not known"),
    "gain": _yes("the robot may drive faster or slower than the model says"),
    "track": _yes("the robot may turn faster or slower than the model says"),
    "limit": _yes("keep away from that limit"),
    "dead time": _yes("the robot may answer later than the model says"),
    "no dead time": _no("dead time and lag are right together"),
    "told together": _no("together they predict the same"),
    "prior kept": _no("where the log did not show it, the robot does not do it"),
    "pose calibration": _no("the controller does not use it"),
    "effect": _yes("drive gently until another log tells it"),
    "unseen effects": _no("the model of what the encoders see is complete"),
    "unknown track": _no("the model around it is complete"),
    "effects left out": _no("the plain model is as good"),
    "network left out": _no("the linear model is as good"),
    # Doubts about scores, and about missing parts of a log.
    "low FIT": _yes("the controller would trust a poor prediction"),
    "FIT falls": _yes("on another drive it may be worse still"),
    "missed dynamics": _no("FIT counts what is missed, and feedback corrects it"),
    "no gyro": _yes("the controller would turn the robot too little"),
    "no wheels": _yes("limits of the wheels are those of another robot"),
    "pose point": _yes("the controller would take the distance for side-slip"),
    "failed drive": _yes("mend it before the robot drives that path"),
}
"""By kind of `Doubt`, and of every finding that is more than a note."""


@dataclass(frozen=True)
class Doubt:
    """Something that a model is not to be trusted for.

    Attributes
    ----------
    kind
        A key of `VERDICTS`.
    words
        What, in a sentence without a full stop.
    """

    kind: str
    words: str

    @property
    def verdict(self) -> DoubtRelevance:
        """Relevance for driving."""
        return VERDICTS[self.kind]

    def about(self, label: str) -> Doubt:
        """Name the part of the model that the doubt is about."""
        return Doubt(self.kind, f"{label}: {self.words}")

    def __str__(self) -> str:
        """Format the doubt in one line, relevance included."""
        return escaped(f"{self.words} ({self.verdict})")


def lines(doubts: Iterable[Doubt]) -> tuple[str, ...]:
    """Format doubts for files and the screen."""
    return tuple(map(str, doubts))
