"""The cost of the sparse problem: z'Pz/2 + q'z."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.mpc.sparse.layout import Layout
from diffdrive_mpc.mpc.sparse.linearised import Linearised
from diffdrive_mpc.mpc.sparse.pattern import Pattern


class Cost:
    """Upper triangle of P with a fixed pattern, and q; `load` writes the numbers of a tick.

    Attributes
    ----------
    matrix
        Upper triangle of P, by columns.
    gradient
        q.
    """

    def __init__(self, layout: Layout, problem: TrackingProblem) -> None:
        self._layout, w = layout, problem.config.weights
        self._pose_weights = problem.pose_weights()
        self._command_weights, self._increments = np.array([w.v, w.omega]), np.array([w.v_increment, w.omega_increment])
        entries, at = Pattern(), layout
        diagonal = np.tile(self._command_weights + 2 * self._increments, (problem.steps, 1))
        diagonal[-1] -= self._increments
        entries.add(at.commands, at.commands, diagonal)
        entries.add(at.commands[:-1], at.commands[1:], -self._increments)
        x, y, theta = at.poses.T
        self._position = [entries.add(row, column) for row, column in ((x, x), (x, y), (y, y))]
        entries.add(theta, theta, self._pose_weights[:, 2])
        for slack in (at.over, at.under):
            entries.add(slack, slack, w.soft_quadratic)
        self.matrix, self._place = entries.build(layout.columns, layout.columns)
        self.gradient = np.zeros(layout.columns)
        self.gradient[at.over] = self.gradient[at.under] = w.soft

    def load(self, at: Linearised) -> None:
        """Write the numbers of one tick."""
        c, s = at.direction.T
        along, across, heading = self._pose_weights.T
        xx, xy, yy = along * c**2 + across * s**2, (along - across) * c * s, along * s**2 + across * c**2
        for where, values in zip(self._position, (xx, xy, yy), strict=True):
            self.matrix.data[self._place[where]] = values
        dx, dy, turned = at.error.T
        poses = np.column_stack([xx * dx + xy * dy, xy * dx + yy * dy, heading * turned])
        self.gradient[self._layout.poses] = poses
        commands = -self._command_weights * at.feed_forward
        commands[0] -= self._increments * at.last_command
        self.gradient[self._layout.commands] = commands
