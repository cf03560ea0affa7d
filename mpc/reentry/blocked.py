"""Whether the robot moves at all while the reference waits for it."""

from __future__ import annotations

import math

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle

# Less than this is no motion but noise of the pose: m, rad.
_STIR = (0.04, 0.1)


class BlockedWatch:
    """Says when the robot has stayed where it is for too long.

    Parameters
    ----------
    after
        Time without motion after which it counts as blocked [s].
    """

    def __init__(self, after: float) -> None:
        self._after = after
        self.restart()

    def restart(self) -> None:
        """Begin anew with the next pose."""
        self._since: float | None = None
        self._pose: FloatArray | None = None

    def look(self, t: float, pose: FloatArray) -> float:
        """How long [s] the robot has been blocked at `pose` (3,), now `t` [s]; 0 if it is not."""
        if self._since is None or self._pose is None or self._moved(pose):
            self._since, self._pose = t, pose
        still = t - self._since
        return still if still >= self._after else 0.0

    def _moved(self, pose: FloatArray) -> bool:
        assert self._pose is not None
        away = math.hypot(pose[0] - self._pose[0], pose[1] - self._pose[1])
        return away > _STIR[0] or abs(float(wrap_angle(pose[2] - self._pose[2]))) > _STIR[1]
