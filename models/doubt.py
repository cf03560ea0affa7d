"""Doubts about a log or a model, with their relevance for driving, which is defined by kind."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from diffdrive_mpc.models.table import escape


@dataclass(frozen=True)
class DoubtRelevance:
    """Relevance of a kind of doubt for driving with the model.

    Attributes
    ----------
    matters
        True if the doubt is relevant.
    why
        Short reason.
    """

    matters: bool
    why: str

    def __str__(self) -> str:
        """Format the relevance as text."""
        return f"{'matters' if self.matters else 'does not matter'} for driving: {self.why}"


def _relevant(why: str) -> DoubtRelevance:
    return DoubtRelevance(True, why)


def _irrelevant(why: str) -> DoubtRelevance:
    return DoubtRelevance(False, why)


_ROBOT = _relevant("the model would not describe a real robot")
_SCALE = _relevant("a speed would be wrong by a factor")
_SIGN = _relevant("the robot would be steered the wrong way")
_LATE = _relevant("the dead time would be wrong by the same amount")
_LEFT_OUT = _irrelevant("the rest of the log is used")
_UNKNOWN = _relevant("the response to motions that were not driven is unknown")

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
    "swapped channels": _SIGN,
    "mirrored pose": _SIGN,
    "late sensor": _irrelevant("`identify` corrects it"),
    "scaled sensor": _irrelevant("`identify` corrects it"),
    "turned pose": _relevant("the reported position would deviate from the driven path"),
    "order change": _SIGN,
    "dead readings": _SCALE,
    "second publisher": _ROBOT,
    "late wheel": _LATE,
    "tyre change": _relevant("the robot would drive a curve for the command of a straight line"),
    "gyro drift": _relevant("the heading would drift by this rate"),
    "reading at rest": _relevant("the pose estimate would drift until the controller has learned this reading"),
    "uneven turns": _relevant("the robot would turn differently to one side"),
    "curved command": _relevant("the robot would follow small commands more slowly than predicted"),
    "scaled poses": _relevant("lengths in the map differ from those on the ground"),
    "slipping wheels": _relevant("on another surface the robot would drive much faster than predicted"),
    "gain drift": _relevant("the robot may drive faster or slower than predicted"),
    "rectified sensor": _SIGN,
    "clipped sensor": _SCALE,
    "filtered sensor": _LATE,
    "echoed command": _ROBOT,
    "latched command": _ROBOT,
    "rounded command": _SCALE,
    "wrong sign": _SIGN,
    "no response": _ROBOT,
    "weak response": _relevant("the log shows little of the robot's motion"),
    "constant input": _UNKNOWN,
    "little excitation": _UNKNOWN,
    "saturation": _relevant("beyond the limit the robot may not follow its command"),
    # Doubts about estimates.
    "second lag": _irrelevant("one lag is sufficient"),
    "divided lag": _irrelevant("the sum of dead time and lag is correct"),
    "equal lags": _irrelevant("the prediction does not depend on their division"),
    "lag": _relevant("the delay of the robot's response is unknown"),
    "gain": _relevant("the robot may drive faster or slower than predicted"),
    "track": _relevant("the robot may turn faster or slower than predicted"),
    "limit": _relevant("commands must stay below this limit"),
    "dead time": _relevant("the robot may respond later than predicted"),
    "no dead time": _irrelevant("the sum of dead time and lag is correct"),
    "inseparable": _irrelevant("the prediction does not depend on their division"),
    "prior kept": _irrelevant("it has no visible effect in the log"),
    "pose calibration": _irrelevant("the controller does not use it"),
    "effect": _relevant("drive gently until it is determined from another log"),
    "unseen effects": _irrelevant("the model of the encoder readings is complete"),
    "unknown track": _irrelevant("the rest of the model is complete"),
    "effects left out": _irrelevant("the plain model predicts as well"),
    "network left out": _irrelevant("the linear model predicts as well"),
    # Doubts about scores, and about missing parts of a log.
    "low FIT": _relevant("the controller would rely on a poor prediction"),
    "FIT falls": _relevant("FIT may be even lower on another drive"),
    "missed dynamics": _irrelevant("FIT includes the missing dynamics, and feedback corrects them"),
    "no heading": _relevant("the controller's estimator needs a heading"),
    "no gyro": _relevant("the robot would turn too little"),
    "no wheels": _relevant("the wheel limits are those of another robot"),
    "pose point": _relevant("the controller would interpret the distance as side-slip"),
    "failed drive": _relevant("the robot must not drive this path before it is corrected"),
}
"""Relevance by kind of `Doubt`, and by kind of every finding more severe than a note."""


@dataclass(frozen=True)
class Doubt:
    """Reason not to rely on some property of a model.

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
        """Return the doubt with its message prefixed by `label`, the part of the model that it concerns."""
        return Doubt(self.kind, f"{label}: {self.message}")

    def __str__(self) -> str:
        """Format the doubt and its relevance in one line."""
        return escape(f"{self.message} ({self.verdict})")


def lines(doubts: Iterable[Doubt]) -> tuple[str, ...]:
    """Format each doubt as a line."""
    return tuple(map(str, doubts))
