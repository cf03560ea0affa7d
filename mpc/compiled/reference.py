"""References sampled in C: the numbers of `mpc.trajectories`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import Reference, ReferenceSample
from diffdrive_mpc.mpc.compiled.library import callable_in, load_library, pointer
from diffdrive_mpc.mpc.trajectories.arcs import ArcTrajectory
from diffdrive_mpc.mpc.trajectories.moved import MovedReference
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

_SOURCES = ("reference.c",)
# More times than this at once are no matter of a tick.
_MOST = 512


class CompiledReference:
    """A trajectory with a table, sampled in C; satisfies `models.interface.Reference`.

    Raises
    ------
    mpc.compiled.compiler.NotCompiledError
        If it cannot be compiled.
    """

    def __init__(self, original: ArcTrajectory | SplineTrajectory) -> None:
        self._original = original
        self.name, self.duration = original.name, original.duration
        arcs = isinstance(original, ArcTrajectory)
        address, number, time = ctypes.c_void_p, ctypes.c_int, ctypes.c_double
        sample = callable_in(
            load_library(_SOURCES, {}),
            "ddmpc_sample_arcs" if arcs else "ddmpc_sample_spline",
            None,
            *(address, address, number, time, address, number, address),
        )
        self._tables = tuple(np.ascontiguousarray(table, dtype=float) for table in (original.breaks, original.table))
        self._times, self._out = np.zeros(_MOST), np.zeros(6 * _MOST)
        self._pose = self._out[: 3 * _MOST].reshape(_MOST, 3)
        self._twist = self._out[3 * _MOST : 5 * _MOST].reshape(_MOST, 2)
        self._arc_length = self._out[5 * _MOST :]
        parts = (pointer(part).value or 0 for part in (self._pose, self._twist, self._arc_length))
        self._samples = np.array(list(parts), dtype=np.uintp)
        breaks, table = (pointer(part) for part in self._tables)
        pieces, times, samples = self._tables[1].shape[1], pointer(self._times), pointer(self._samples)
        self._sample: Callable[[int], None] = lambda count: sample(
            breaks, table, pieces, original.duration, times, count, samples
        )

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """See `mpc.trajectories.trajectory.Trajectory`."""
        wanted = np.asarray(times, dtype=float).reshape(-1)
        count = wanted.size
        if count > _MOST:
            return self._original.sample(wanted)
        self._times[:count] = wanted
        self._sample(count)
        return ReferenceSample(self._pose[:count].copy(), self._twist[:count].copy(), self._arc_length[:count].copy())


def compile_reference(reference: Reference) -> Reference:
    """`reference`, or what samples it in C where that is known how.

    Raises
    ------
    mpc.compiled.compiler.NotCompiledError
        If it cannot be compiled.
    """
    if isinstance(reference, MovedReference):
        return replace(reference, original=compile_reference(reference.original))
    return CompiledReference(reference) if isinstance(reference, ArcTrajectory | SplineTrajectory) else reference
