"""References in closed form, which the compiled core can sample."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.mpc.core.library import load_core
from diffdrive_mpc.mpc.trajectories.trajectory import Trajectory

_ARC_ROWS, _CUBIC_ROWS = 10, 16


class NativeTrajectory:
    """Table of pieces for the core, rotated and then translated by `motion` (3,) [m, m, rad].

    Parameters
    ----------
    breaks
        (pieces,) or (pieces + 1,) start times of the pieces [s].
    table
        (10, pieces) of arcs or (16, pieces) of cubics, see `mpc.problem.formulas`.
    duration
        Duration [s].
    """

    def __init__(self, breaks: FloatArray, table: FloatArray, duration: float, motion: ArrayLike = (0, 0, 0)) -> None:
        ffi, self._lib = load_core()
        self._ffi = ffi
        # The structure holds only addresses, so the arrays must live as long as the structure.
        self._arrays = np.ascontiguousarray(breaks, dtype=float), np.ascontiguousarray(table, dtype=float)
        rows, pieces = table.shape
        if rows not in (_ARC_ROWS, _CUBIC_ROWS) or len(breaks) not in (pieces, pieces + 1) or pieces < 1:
            raise ValueError(f"table of shape {table.shape} with {len(breaks)} breaks: not a trajectory")
        self.struct = ffi.new(
            "ddmpc_trajectory *",
            {
                "breaks": ffi.cast("const double *", self._arrays[0].ctypes.data),
                "table": ffi.cast("const real *", self._arrays[1].ctypes.data),
                "pieces": pieces,
                "cubic": rows == _CUBIC_ROWS,
                "duration": float(duration),
                "motion": np.asarray(motion, dtype=float).tolist(),
            },
        )

    @property
    def breaks(self) -> FloatArray:
        """(pieces,) or (pieces + 1,) start times of the pieces [s]."""
        return self._arrays[0]

    @property
    def table(self) -> FloatArray:
        """(10, pieces) of arcs or (16, pieces) of cubics."""
        return self._arrays[1]

    @property
    def motion(self) -> FloatArray:
        """(3,) translation x, y [m] after the rotation by theta [rad]."""
        return np.array(list(self.struct.motion))

    def moved(self, motion: ArrayLike) -> NativeTrajectory:
        """Return the original trajectory with the given motion instead of the current motion."""
        return NativeTrajectory(self.breaks, self.table, self.struct.duration, motion)

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Sample at `times` (n,) [s]; see `Trajectory.sample`."""
        time_array = np.ascontiguousarray(np.asarray(times, dtype=float).reshape(-1))
        count = time_array.size
        # One block for the three results: 3, 2 and 1 numbers of 8 bytes per time, hence the offsets of 24 and 40 bytes.
        block = np.empty(6 * count)
        pose, twist, arc_length = block[: 3 * count], block[3 * count : 5 * count], block[5 * count :]
        cast = self._ffi.cast
        start = block.ctypes.data
        self._lib.ddmpc_sample(
            self.struct,
            cast("const double *", time_array.ctypes.data),
            count,
            cast("real *", start),
            cast("real *", start + 24 * count),
            cast("real *", start + 40 * count),
        )
        return ReferenceSample(pose.reshape(count, 3), twist.reshape(count, 2), arc_length)


class NativeReference:
    """C structure `ddmpc_reference` of a reference.

    Attributes
    ----------
    struct
        Structure for the core.
    complete
        True if the core can sample the reference. Otherwise the core uses only duration and end pose, and Python
        provides the samples.
    """

    def __init__(self, reference: Reference) -> None:
        # The C table of the reference, if the core can sample it.
        native = getattr(reference, "native", None)
        self._trajectory = native if isinstance(native, NativeTrajectory) else _end_pose(reference)
        self.complete = self._trajectory is native
        ffi, lib = load_core()
        self.struct = ffi.new(
            "ddmpc_reference *",
            {
                "sample": ffi.addressof(lib, "ddmpc_sample_one"),
                "context": ffi.cast("const void *", self._trajectory.struct),
                "duration": float(reference.duration),
            },
        )


def _end_pose(reference: Reference) -> NativeTrajectory:
    """Build a trajectory that stays at the end pose of a reference."""
    table = np.zeros((_ARC_ROWS, 1))
    # Rows 1 to 3 are the start pose; zeros in all other rows mean standstill.
    table[1:4, 0] = reference.sample([reference.duration]).pose[0]
    return NativeTrajectory(np.zeros(1), table, reference.duration)


@dataclass(frozen=True, eq=False, repr=False)
class TableTrajectory(Trajectory):
    """Trajectory that the compiled core samples; subclasses define its `breaks` and `table`."""

    breaks: FloatArray
    table: FloatArray

    @cached_property
    def native(self) -> NativeTrajectory:
        """Table of the trajectory in the compiled core."""
        return NativeTrajectory(self.breaks, self.table, self.duration)

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Sample at `times` (n,) [s]; see `Trajectory.sample`."""
        return self.native.sample(times)

    def delayed(self, seconds: float) -> Self:
        """Return the trajectory with a preceding standstill of `seconds` [s] at its start pose."""
        # Only the pose rows are not zero: the start pose of an arc, or the constant terms of cubics.
        standstill = np.zeros((len(self.table), 1))
        pose = slice(1, 4) if len(self.table) == _ARC_ROWS else slice(12, 15)
        standstill[pose] = self.table[pose, :1]
        breaks, table = np.append(0.0, seconds + self.breaks), np.hstack([standstill, self.table])
        return replace(self, duration=seconds + self.duration, breaks=breaks, table=table)

    def __getstate__(self) -> dict[str, object]:
        """Return the state without `native`, which holds memory of the core."""
        return {name: value for name, value in self.__dict__.items() if name != "native"}


def table_of(reference: Reference) -> dict[str, Any] | None:
    """Return name, duration, breaks, table and motion of a reference in closed form; None for other references."""
    native = getattr(reference, "native", None)
    if not isinstance(native, NativeTrajectory):
        return None
    arrays = {name: getattr(native, name).tolist() for name in ("breaks", "table", "motion")}
    return {"name": reference.name, "duration": reference.duration} | arrays
