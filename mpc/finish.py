"""When the end of the reference counts as reached."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import Reference
from diffdrive_mpc.mpc.config.schema import Finish
from diffdrive_mpc.mpc.estimate import Estimate


class FinishWatch:
    """Says when the robot rests at the end of its reference, or has had the time to; what is finished stays so."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin anew."""
        self._finished = False

    def look(self, estimate: Estimate, time: float, reference: Reference, settings: Finish, notes: list[str]) -> bool:
        """Whether it is finished at `time` [s] on the reference's clock; `notes` gets a line if it is not at rest."""
        if self._finished or time < reference.duration:
            return self._finished
        end = reference.sample([reference.duration]).pose[0]
        distance = float(np.hypot(*(estimate.pose - end)[:2]))
        settled = distance <= settings.position and (np.abs(estimate.twist) <= settings.speed).all()
        late = time >= reference.duration + settings.timeout
        if late and not settled:
            notes.append(f"finished {distance:.3f} m from the end, not at rest within {settings.timeout} s")
        self._finished = bool(settled or late)
        return self._finished
