"""A trajectory as the table that it is made of: to be written down, and to be tracked again bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import Reference, ReferenceSample
from diffdrive_mpc.mpc.trajectories.native import NativeTrajectory
from diffdrive_mpc.mpc.trajectories.trajectory import Trajectory


@dataclass(frozen=True, eq=False, repr=False)
class TabledTrajectory(Trajectory):
    """A trajectory from a table.

    Attributes
    ----------
    native
        The table in the compiled core.
    """

    native: NativeTrajectory

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> TabledTrajectory:
        """The trajectory of what `table_of` gave; raises ConfigError where it is something else."""
        try:
            breaks, table = (np.array(data[name], dtype=float) for name in ("breaks", "table"))
            native = NativeTrajectory(breaks, table, float(data["duration"]), data["motion"])
            return cls(str(data["name"]), float(data["duration"]), native)
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError(f"the recorded reference cannot be read ({error})") from error

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s]; see `Trajectory.sample`."""
        return self.native.sample(times)


def table_of(reference: Reference) -> dict[str, Any] | None:
    """Name, duration, breaks, table and motion of a reference in closed form, as plain values; None of another."""
    native = getattr(reference, "native", None)
    if not isinstance(native, NativeTrajectory):
        return None
    arrays = {name: getattr(native, name).tolist() for name in ("breaks", "table", "motion")}
    return {"name": reference.name, "duration": reference.duration} | arrays
