"""Ways of three pieces from a pose to a pose, in closed form for any constant twists, side-slip included.

A body under a constant twist turns about a centre c that is fixed in its own frame. With headings a and b at the two
joints, D from the centre of the first arc to that of the last is R(a) (L d + c3 - c1) for arc-straight-arc, d being the
direction in which straight on drifts, and R(a) (c2 - c1) + R(b) (c3 - c2) for three arcs: a line whose length is known,
and an arm of two links. Without slip and with one radius these are the words of Dubins, American Journal of Mathematics
79(3), 1957.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.planner.inputs import Index, Inputs, Mask

_WHOLE = 2 * np.pi
_SAME = 1e-9


class Words(NamedTuple):
    """k ways."""

    start: Index
    """(k,) from which of the poses"""
    inputs: Index
    """(k, 3)"""
    times: FloatArray
    """(k, 3) [s]"""
    costs: FloatArray
    """(k,)"""


def arc_straight_arc(inputs: Inputs, poses: FloatArray, goal: FloatArray) -> Words:
    """Every pair of arcs with straight on between, from poses (n, 3) to one goal (3,)."""
    arcs, lines = np.flatnonzero(~inputs.straight), np.flatnonzero(inputs.straight)
    first, line, last = (one.ravel() for one in np.meshgrid(arcs, lines, arcs, indexing="ij"))
    centres = inputs.centres
    drift, speed = inputs.twists[line, :2], inputs.speeds[line]
    along, gap = drift / speed[:, None], centres[last] - centres[first]
    between = _placed(goal, centres[last])[None] - _placed(poses[:, None], centres[first])
    ahead = (along * gap).sum(-1)
    square = ahead**2 + (between**2).sum(-1) - (gap**2).sum(-1)
    length = np.sqrt(np.maximum(square, 0.0)) - ahead
    reach = length[..., None] * along + gap
    heading = np.arctan2(between[..., 1], between[..., 0]) - np.arctan2(reach[..., 1], reach[..., 0])
    times = np.stack(
        [
            _turned(inputs, first, heading - poses[:, None, 2]),
            length / speed,
            _turned(inputs, last, goal[2] - heading),
        ],
        axis=-1,
    )
    return _kept(inputs, np.stack([first, line, last], -1), times, (square >= 0) & (length >= -_SAME))


def arc_arc_arc(inputs: Inputs, poses: FloatArray, goal: FloatArray) -> Words:
    """Every three arcs that differ from their neighbours, from poses (n, 3) to one goal (3,)."""
    arcs = np.flatnonzero(~inputs.straight & (inputs.speeds > _SAME))
    first, middle, last = (one.ravel() for one in np.meshgrid(arcs, arcs, arcs, indexing="ij"))
    differ = (first != middle) & (middle != last)
    first, middle, last = first[differ], middle[differ], last[differ]
    centres = inputs.centres
    near, far = centres[middle] - centres[first], centres[last] - centres[middle]
    between = _placed(goal, centres[last])[None] - _placed(poses[:, None], centres[first])
    one, two = np.hypot(*near.T), np.hypot(*far.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        bent = ((between**2).sum(-1) - one**2 - two**2) / (2 * one * two)
    fits, paths = np.abs(bent) <= 1, []
    for side in (1.0, -1.0):
        elbow = side * np.arccos(np.clip(bent, -1, 1))
        shoulder = np.arctan2(between[..., 1], between[..., 0]) - np.arctan2(
            two * np.sin(elbow), one + two * np.cos(elbow)
        )
        a = shoulder - np.arctan2(near[:, 1], near[:, 0])
        b = shoulder + elbow - np.arctan2(far[:, 1], far[:, 0])
        times = np.stack(
            [
                _turned(inputs, first, a - poses[:, None, 2]),
                _turned(inputs, middle, b - a),
                _turned(inputs, last, goal[2] - b),
            ],
            axis=-1,
        )
        paths.append(_kept(inputs, np.stack([first, middle, last], -1), times, fits))
    return Words(*(np.concatenate(parts) for parts in zip(*paths, strict=True)))


def arc_straight(inputs: Inputs, poses: FloatArray, point: FloatArray) -> Words:
    """Every arc with straight on to a point (2,) behind it, from poses (n, 3); the third piece lasts no time."""
    arcs, lines = np.flatnonzero(~inputs.straight), np.flatnonzero(inputs.straight)
    first, line = (one.ravel() for one in np.meshgrid(arcs, lines, indexing="ij"))
    centre = inputs.centres[first]
    speed = inputs.speeds[line]
    along = inputs.twists[line, :2] / speed[:, None]
    between = point - _placed(poses[:, None], centre)
    ahead = (along * centre).sum(-1)
    square = ahead**2 + (between**2).sum(-1) - (centre**2).sum(-1)
    length = ahead + np.sqrt(np.maximum(square, 0.0))
    reach = length[..., None] * along - centre
    heading = np.arctan2(between[..., 1], between[..., 0]) - np.arctan2(reach[..., 1], reach[..., 0])
    turned = _turned(inputs, first, heading - poses[:, None, 2])
    times = np.stack([turned, length / speed, np.zeros_like(turned)], axis=-1)
    return _kept(inputs, np.stack([first, line, line], -1), times, (square >= 0) & (length >= -_SAME))


def placed(poses: FloatArray, moved: FloatArray) -> FloatArray:
    """(..., 3) poses after displacements (..., 3) in their own frames; headings are not wrapped."""
    return np.concatenate([_placed(poses, moved[..., :2]), poses[..., 2:] + moved[..., 2:]], axis=-1)


def _placed(poses: FloatArray, points: FloatArray) -> FloatArray:
    c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    x, y = points[..., 0], points[..., 1]
    return np.stack([poses[..., 0] + c * x - s * y, poses[..., 1] + s * x + c * y], axis=-1)


def _turned(inputs: Inputs, index: Index, angle: FloatArray) -> FloatArray:
    """Time that an input takes to turn the body by `angle`, the way it turns [s]."""
    omega = inputs.twists[index, 2]
    around = np.mod(np.sign(omega) * angle, _WHOLE)
    return np.asarray(np.where(around > _WHOLE - 1e-7, 0.0, around) / np.abs(omega))


def _kept(inputs: Inputs, index: Index, times: FloatArray, fits: Mask) -> Words:
    start, word = np.nonzero(fits)
    lasting = np.maximum(times[start, word], 0.0)
    chosen = index[word]
    return Words(start, chosen, lasting, (lasting * inputs.rates[chosen]).sum(axis=-1))
