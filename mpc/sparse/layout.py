"""Where the variables and rows of the sparse problem lie."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.mpc.quadratic_program import Kinds
from diffdrive_mpc.mpc.sparse.pattern import Indices


class Layout:
    """Numbers of the variables and rows of each group, by step.

    Parameters
    ----------
    steps
        Horizon N.
    order
        States n of the velocity model.
    soft_kinds
        The kinds of soft limit that are included.

    Attributes
    ----------
    commands, states, twists, poses
        Variables (N, 2), (N, n), (N, 2), (N, 3): commands at the samples 0 to N - 1, the others at the samples 1 to N.
    over, under
        Variables (kinds, N): by how much soft limits are exceeded upwards and downwards.
    state_rows, twist_rows, pose_rows
        (N, n), (N, 2), (N, 3): the equations that give these variables.
    range_rows, increment_rows
        (N, 2): hard limits.
    soft_rows, over_rows, under_rows
        (kinds, N): soft limits, and the sign of their slacks.
    """

    def __init__(self, steps: int, order: int, soft_kinds: Kinds) -> None:
        kinds = len(soft_kinds)
        columns = [(steps, 2), (steps, order), (steps, 2), (steps, 3), (kinds, steps), (kinds, steps)]
        self.commands, self.states, self.twists, self.poses, self.over, self.under = _number(columns)
        self.columns = sum(rows * width for rows, width in columns)
        rows = [(steps, order), (steps, 2), (steps, 3), (steps, 2), (steps, 2), *[(kinds, steps)] * 3]
        groups = _number(rows)
        self.state_rows, self.twist_rows, self.pose_rows, self.range_rows, self.increment_rows = groups[:5]
        self.soft_rows, self.over_rows, self.under_rows = groups[5:]
        self.rows = sum(height * width for height, width in rows)
        # For every row that of the same kind one step later; at the end of the horizon the row itself.
        ahead = [np.vstack([group[1:], group[-1:]]) for group in groups[:5]]
        ahead += [np.hstack([group[:, 1:], group[:, -1:]]) for group in groups[5:]]
        self.ahead: Indices = np.concatenate([group.reshape(-1) for group in ahead])


def _number(shapes: Sequence[tuple[int, int]]) -> list[Indices]:
    """Arrays of the given shapes with running numbers."""
    ends = np.cumsum([rows * width for rows, width in shapes])
    return [
        np.arange(end - rows * width, end).reshape(rows, width) for (rows, width), end in zip(shapes, ends, strict=True)
    ]
