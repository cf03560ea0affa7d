"""The rows of the sparse problem: equations of the dynamics, hard limits, soft limits."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.qp.limit_rows import HARD_KINDS
from diffdrive_mpc.mpc.quadratic_program import Kinds
from diffdrive_mpc.mpc.sparse.layout import Layout
from diffdrive_mpc.mpc.sparse.linearised import Linearised
from diffdrive_mpc.mpc.sparse.pattern import Indices, Pattern

_ACROSS = 4
"""Place of the distance across the path among the soft limits."""


class Constraints:
    """lower <= A z <= upper with a fixed pattern of A; `load` writes the numbers of a tick.

    Attributes
    ----------
    matrix
        A, by columns.
    lower, upper
        Bounds; equal for equations.
    """

    def __init__(self, layout: Layout, model: DiscreteModel, soft_kinds: Kinds) -> None:
        self._layout, self._dt = layout, model.dt
        self._soft = [kind - HARD_KINDS for kind in soft_kinds]
        entries = Pattern()
        self._add_velocity(entries, model)
        self._varying = self._add_poses(entries)
        self._add_hard_limits(entries)
        self._soft_entries = self._add_soft_limits(entries)
        self.matrix, self._place = entries.build(layout.rows, layout.columns)
        self.lower, self.upper = np.zeros(layout.rows), np.zeros(layout.rows)
        self.upper[layout.over_rows] = self.upper[layout.under_rows] = np.inf

    def _add_velocity(self, entries: Pattern, model: DiscreteModel) -> None:
        """States from states and delayed commands, twists from states."""
        at, steps = self._layout, len(self._layout.commands)
        entries.add(at.state_rows, at.states, 1.0)
        i, j = np.nonzero(model.A)
        entries.add(at.state_rows[1:, i], at.states[:-1, j], -model.A[i, j])
        for matrix, more in ((model.B0, 0), (model.B1, 1)):
            for i, channel in zip(*np.nonzero(matrix), strict=True):
                late = min(int(model.delay[channel]) + more, steps)
                rows, sent = at.state_rows[late:, i], at.commands[: steps - late, channel]
                entries.add(rows, sent, -matrix[i, channel])
        entries.add(at.twist_rows, at.twists, 1.0)
        i, j = np.nonzero(model.C)
        entries.add(at.twist_rows[:, i], at.states[:, j], -model.C[i, j])

    def _add_poses(self, entries: Pattern) -> tuple[slice, slice, slice]:
        """Deviations of the poses: from the ones before, the twists at both ends of the arc, and the heading."""
        at = self._layout
        entries.add(at.pose_rows, at.poses, 1.0)
        entries.add(at.pose_rows[1:], at.poses[:-1], -1.0)
        # (N, 3, 2): how x, y and theta answer to v and omega; theta does not to v, but one pattern is simpler.
        after = entries.add(at.pose_rows[:, :, None], at.twists[:, None, :])
        before = entries.add(at.pose_rows[1:, :, None], at.twists[:-1, None, :])
        heading = entries.add(at.pose_rows[1:, :2], at.poses[:-1, 2:])
        return after, before, heading

    def _add_hard_limits(self, entries: Pattern) -> None:
        at = self._layout
        entries.add(at.range_rows, at.commands, 1.0)
        entries.add(at.increment_rows, at.commands, 1.0)
        entries.add(at.increment_rows[1:], at.commands[:-1], -1.0)

    def _add_soft_limits(self, entries: Pattern) -> list[slice]:
        """For each kind its gradients (N, 2), by twist or by position."""
        at, varying = self._layout, []
        for row, kind in enumerate(self._soft):
            of = at.poses[:, :2] if kind == _ACROSS else at.twists
            varying.append(entries.add(at.soft_rows[row][:, None], of))
        for slack, sign, bound in ((at.over, -1.0, at.over_rows), (at.under, 1.0, at.under_rows)):
            entries.add(at.soft_rows, slack, sign)
            entries.add(bound, slack, 1.0)
        return varying

    def load(self, at: Linearised) -> None:
        """Write the numbers of one tick."""
        layout, data, place = self._layout, self.matrix.data, self._place
        # Half of each end's twist, through the gain of the body.
        by_twist = np.zeros((len(at.moves), 3, 2))
        by_twist[:, :2] = at.moves[:, :, :2] * at.gains
        by_twist[:, 2, 1] = self._dt * at.gains[1]
        after, before, heading = self._varying
        data[place[after]] = (-0.5 * by_twist).reshape(-1)
        data[place[before]] = (-0.5 * by_twist[1:]).reshape(-1)
        data[place[heading]] = -at.moves[1:, :, 2].reshape(-1)
        mean = 0.5 * at.twists
        mean[1:] += 0.5 * at.twists[:-1]
        moved = -np.einsum("kij,kj->ki", by_twist, mean)
        self.lower[layout.pose_rows] = self.upper[layout.pose_rows] = moved
        self._bound(layout.range_rows, -at.box, at.box)
        slew = np.tile(at.slew, (len(at.box), 1))
        self._bound(layout.increment_rows, -slew, slew)
        self._bound(layout.increment_rows[0], at.last_command - at.slew, at.last_command + at.slew)
        for kind, where in zip(self._soft, self._soft_entries, strict=True):
            data[place[where]] = _soft_gradient(at, kind).reshape(-1)
        self._bound(layout.soft_rows, at.soft_lower[self._soft], at.soft_upper[self._soft])

    def _bound(self, rows: Indices, lower: FloatArray, upper: FloatArray) -> None:
        self.lower[rows], self.upper[rows] = lower, upper


def _soft_gradient(at: Linearised, kind: int) -> FloatArray:
    """(N, 2) soft limit `kind`, 0 to 4, by the twists, or that across the path by the positions."""
    if kind == _ACROSS:
        return np.column_stack([-at.direction[:, 1], at.direction[:, 0]])
    return np.tile(at.soft_rows[kind], (len(at.twists), 1))
