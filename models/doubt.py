"""Doubts about a log or a model, and their relevance for driving, defined once for each kind."""

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
        True if the doubt is relevant.
    why
        Reason, in a few words.
    """

    matters: bool
    why: str

    def __str__(self) -> str:
        """Format the relevance as text."""
        return f"{'matters' if self.matters else 'does not matter'} for driving: {self.why}"


def _yes(why: str) -> DoubtRelevance:
    return DoubtRelevance(True, why)


def _no(why: str) -> DoubtRelevance:
    return DoubtRelevance(False, why)


_ROBOT = _yes("the model would describe no real robot")
_SCALE = _yes("a speed would be wrong by a factor")
_SIGN = _yes("the robot would be steered the wrong way")
_LATE = _yes("the dead time would be wrong by the same amount")
_LEFT_OUT = _no("the rest of the log is used")
_UNKNOWN = _yes("the response to motions that were not driven is unknown")

VERDICTS: Mapping[str, DoubtRelevance] = {
    # Doubts about logs: kinds of `models.logs.Finding`.
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
    "late sensor": _no("`identify` corrects it"),
    "scaled sensor": _no("`identify` corrects it"),
    "turned pose": _yes("the reported position would be off the driven path"),
    "order change": _SIGN,
    "dead readings": _SCALE,
    "second publisher": _ROBOT,
    "late wheel": _LATE,
    "tyre change": _yes("the robot would drive a curve for the command of a straight line"),
    "gyro drift": _yes("the heading would drift as much"),
    "curved command": _yes("the robot would follow small commands more slowly than predicted"),
    "scaled poses": _yes("lengths in the map differ from those on the ground"),
    "slipping wheels": _yes("on another surface the robot would drive much faster than predicted"),
    "gain drift": _yes("the robot may drive faster or slower than predicted"),
    "rectified sensor": _SIGN,
    "clipped sensor": _SCALE,
    "filtered sensor": _LATE,
    "echoed command": _ROBOT,
    "latched command": _ROBOT,
    "rounded command": _SCALE,
    "wrong sign": _SIGN,
    "no response": _ROBOT,
    "weak response": _yes("the log shows little of the robot's motion"),
    "constant input": _UNKNOWN,
    "little excitation": _UNKNOWN,
    "saturation": _yes("beyond the limit the robot may not follow its command"),
    # Doubts about estimates.
    "second lag": _no("one lag is enough"),
    "divided lag": _no("the sum of dead time and lag is correct"),
    "equal lags": _no("together they predict the same"),
    "lag": _yes("the delay of the robot's response is unknown"),
    "gain": _yes("the robot may drive faster or slower than predicted"),
    "track": _yes("the robot may turn faster or slower than predicted"),
    "limit": _yes("stay below that limit"),
    "dead time": _yes("the robot may respond later than predicted"),
    "no dead time": _no("the sum of dead time and lag is correct"),
    "inseparable": _no("together they predict the same"),
    "prior kept": _no("the log shows no sign of it"),
    "pose calibration": _no("the controller does not use it"),
    "effect": _yes("drive gently until another log determines it"),
    "unseen effects": _no("the model of the encoder readings is complete"),
    "unknown track": _no("the rest of the model is complete"),
    "effects left out": _no("the plain model is as good"),
    "network left out": _no("the linear model is as good"),
    # Doubts about scores, and about missing parts of a log.
    "low FIT": _yes("the controller would rely on a poor prediction"),
    "FIT falls": _yes("on another drive FIT may be lower still"),
    "missed dynamics": _no("FIT includes the missing dynamics, and feedback corrects them"),
    "no heading": _yes("the controller's estimator needs a heading"),
    "no gyro": _yes("the controller would turn the robot too little"),
    "no wheels": _yes("the wheel limits are those of another robot"),
    "pose point": _yes("the controller would take the distance for side-slip"),
    "failed drive": _yes("correct it before the robot drives that path"),
}
"""Relevance by kind of `Doubt`, and by kind of every finding more severe than a note."""


@dataclass(frozen=True)
class Doubt:
    """Reason not to rely on a part of a model.

    Attributes
    ----------
    kind
        A key of `VERDICTS`.
    message
        Description, a sentence without a full stop.
    """

    kind: str
    message: str

    @property
    def verdict(self) -> DoubtRelevance:
        """Relevance for driving."""
        return VERDICTS[self.kind]

    def about(self, label: str) -> Doubt:
        """Return the doubt with `label`, the part of the model that it concerns, in front."""
        return Doubt(self.kind, f"{label}: {self.message}")

    def __str__(self) -> str:
        """Format the doubt and its relevance in one line."""
        return escaped(f"{self.message} ({self.verdict})")


def lines(doubts: Iterable[Doubt]) -> tuple[str, ...]:
    """Format each doubt as a line."""
    return tuple(map(str, doubts))
