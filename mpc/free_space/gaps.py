"""Gaps between a footprint and pieces, worked out by the compiled library."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.core.library import load_core
from diffdrive_mpc.mpc.free_space.pieces import Pieces, PlacedFootprint


def address(array: NDArray[Any], kind: str = "const real *") -> Any:  # noqa: ANN401 - cffi has no types
    """Where an array lies, for C."""
    return load_core()[0].cast(kind, array.ctypes.data)


def gap_to(
    footprint: PlacedFootprint, pieces: Pieces, piece: int, pose: ArrayLike, time: float = 0.0
) -> tuple[float, FloatArray]:
    """Signed distance to one piece [m], and the direction (2,) in which the gap lies, from the footprint.

    Parameters
    ----------
    footprint, pieces, piece
        Between which: of the pieces the one with this index.
    pose
        (3,) of the footprint.
    time
        Since the pieces were where they are said to be [s].
    """
    placed, normal = np.array(pose, dtype=float), np.empty(2)
    lib = load_core()[1]
    gap = lib.ddmpc_gap(footprint.struct, pieces.struct, piece, address(placed), time, address(normal, "real *"))
    return float(gap), normal


def least_gaps(
    footprint: PlacedFootprint, pieces: Pieces, poses: FloatArray, times: FloatArray, enough: float
) -> tuple[FloatArray, NDArray[np.intc]]:
    """(k,) least gaps at poses (k, 3), at most `enough` [m], and the nearest pieces; -1 where there is none so near."""
    placed, instants = np.ascontiguousarray(poses, dtype=float), np.ascontiguousarray(times, dtype=float)
    gaps, nearest = np.empty(len(placed)), np.empty(len(placed), dtype=np.intc)
    load_core()[1].ddmpc_clearances(
        footprint.struct,
        pieces.struct,
        len(placed),
        address(placed),
        address(instants),
        enough,
        address(gaps, "real *"),
        address(nearest, "int *"),
    )
    return gaps, nearest
