"""External request to the controller to stop."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Hold:
    """Request to the controller to brake and stand while the reference waits.

    Attributes
    ----------
    reason
        Reason for the hold; part of the step's message.
    failure
        True if the hold counts as a failure: `failure.resume` and `failure.resume_within` of the configuration then
        determine whether the robot continues by itself when the hold ends. False for a pause.
    waits
        True if the robot waits for `start` or `resume` after the hold, whatever the duration of the hold.
    """

    reason: str
    failure: bool = False
    waits: bool = False
