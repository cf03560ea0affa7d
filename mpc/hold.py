"""A reason from outside the controller not to drive."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Hold:
    """Request to the controller to brake and stand; the reference waits meanwhile.

    Attributes
    ----------
    reason
        Why, in words; it becomes part of the step's message.
    failure
        Whether it counts as a failure: then `failure.resume` and `failure.resume_within` of the configuration decide
        whether the robot drives on by itself when the hold ends. A pause is no failure.
    waits
        Whether the robot waits for `start` or `resume` when the hold ends, however short it was.
    """

    reason: str
    failure: bool = False
    waits: bool = False
