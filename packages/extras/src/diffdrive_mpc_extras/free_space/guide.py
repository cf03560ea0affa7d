"""Path around obstacles: a lateral offset of the reference at each node, and the end of the free path.

The horizon of the controller is too short to plan around obstacles. So a path is searched over the distance
`look_ahead`: lateral offsets by dynamic programming, which are smoothed and checked with the footprint at each node.
Deviations from the previous path have a cost, so that the side on which an obstacle is passed rarely changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.mpc.config.fixed_values import STANDING, TURNING
from diffdrive_mpc_extras.free_space.config import FreeSpace
from diffdrive_mpc_extras.free_space.pieces import Pieces, PlacedFootprint, address, load_free_space, min_gaps

SPACING = 0.05
"""Distance between two nodes [m]; larger if a reference would have more than `MAX_NODES` nodes."""
MAX_NODES = 100_000
_MAX_SAMPLES = 100_000
# Distance from a turn on the spot or a cusp within which nodes get no offset [m].
_FIXED_WITHIN = 0.1


@dataclass(frozen=True, eq=False)
class PathTable:
    """Nodes of a path at equal distances.

    Attributes
    ----------
    spacing
        Distance between two nodes [m].
    pose
        (m, 3) poses x, y [m], theta [rad] (unwrapped).
    travel
        (m,) direction of travel: 1 forwards, -1 backwards.
    curvature
        (m,) change of heading by distance [rad/m].
    speed
        (m,) speed of the reference [m/s].
    fixed
        (m,) 1 for a node that must stay on the reference, else 0: the end, turns on the spot, and changes of direction.
    """

    spacing: float
    pose: FloatArray
    travel: FloatArray
    curvature: FloatArray
    speed: FloatArray
    fixed: FloatArray

    @classmethod
    def build(cls, reference: Reference) -> PathTable:
        """Build the table of a reference."""
        times = np.linspace(0.0, reference.duration, min(int(reference.duration / 0.02) + 2, _MAX_SAMPLES))
        sample = reference.sample(times)
        arc, v, omega = sample.arc_length, sample.twist[:, 0], sample.twist[:, 1]
        spacing = max(SPACING, float(arc[-1]) / MAX_NODES)
        nodes = np.arange(int(arc[-1] / spacing) + 2) * spacing
        pose = np.stack([np.interp(nodes, arc, column) for column in sample.pose.T], axis=1)
        moves = np.abs(v) > STANDING
        direction = np.where(v[moves] < 0.0, -1.0, 1.0) if moves.any() else np.ones(1)
        moving_arc = arc[moves] if moves.any() else np.zeros(1)
        travel = np.sign(np.interp(nodes, moving_arc, direction) + 1e-12)
        curvature = np.interp(nodes, moving_arc, omega[moves] / np.abs(v[moves]) if moves.any() else np.zeros(1))
        speed = np.interp(nodes, moving_arc, np.abs(v[moves]) if moves.any() else np.zeros(1))
        turns = ~moves & (np.abs(omega) > TURNING)
        cusps = np.flatnonzero(np.diff(direction) != 0.0)
        anchors = np.concatenate([arc[turns], moving_arc[cusps], arc[-1:]])
        index = np.searchsorted(np.sort(anchors), nodes)
        anchors = np.concatenate([[-np.inf], np.sort(anchors), [np.inf]])
        fixed = np.minimum(nodes - anchors[index], anchors[index + 1] - nodes) <= _FIXED_WITHIN
        return cls(spacing, pose, travel, curvature, speed, fixed.astype(float))

    def __len__(self) -> int:
        """Return the number of nodes."""
        return len(self.pose)


_STEP = 0.025  # distance between two candidate offsets [m]; a doorway leaves some 4 cm
_STRIDE = 2  # distance between two stations of the search [nodes]
_SLOPES, _STRAIGHT = 9, 4
# Weights of the squared second and third differences in the smoothing, and weights of the deviation that are tried.
_BEND, _JERK = 0.02, 0.02
_TRUST = (0.02, 0.2, 2.0, 20.0)
# Number of nodes at the robot that a new path does not change.
_PINNED = 3
# Time ahead of the robot within which the path is not changed, because the plan already follows it [s].
_AHEAD = 0.4
_ROUNDING = 0.001  # tolerance of a gap [m]


class Guide:
    """Path around obstacles along one reference.

    Parameters
    ----------
    table
        Nodes of the reference.
    footprint
        Footprint of the robot.
    settings
        Range of the search, maximum offset of a node, and gaps.

    Attributes
    ----------
    offset
        (m,) offset of each node to the left of its heading [m].
    slope
        (m,) derivative of the offset with respect to the arc length.
    bent
        True if any node has an offset.
    ends
        Arc length at which the free path ends [m]; infinity if it does not end.
    blocked_by
        Index of the piece that ends the path, -1 for none.
    """

    def __init__(self, table: PathTable, footprint: PlacedFootprint, settings: FreeSpace) -> None:
        self.table, self._footprint, self._settings = table, footprint, settings
        self.offset: FloatArray = np.zeros(len(table))
        self.slope: FloatArray = np.zeros(len(table))
        self.ends, self.blocked_by = math.inf, -1
        self._first, self._gaps = 0, np.full(1, math.inf)
        self._speeds: FloatArray = np.full(1, math.inf)
        self.bent = False

    def poses(self, nodes: NDArray[np.intp] | slice) -> FloatArray:
        """Return the poses (k, 3) of the path with its offsets at some nodes."""
        table, offset = self.table, self.offset
        pose, travel = table.pose[nodes], table.travel[nodes]
        if not self.bent:
            return np.ascontiguousarray(pose)
        slope, shift = self.slope[nodes], offset[nodes]
        rotation = np.arctan2(travel * slope, 1.0 - travel * shift * table.curvature[nodes])
        return np.stack(
            [
                pose[:, 0] - np.sin(pose[:, 2]) * shift,
                pose[:, 1] + np.cos(pose[:, 2]) * shift,
                pose[:, 2] + rotation,
            ],
            axis=1,
        )

    def node(self, arc: float) -> int:
        """Return the node at or before an arc length [m]."""
        return min(max(int(arc / self.table.spacing), 0), len(self.table) - 1)

    def update(
        self,
        arc: float,
        v: float,
        pieces: Pieces,
        gap: tuple[float, float],
        limits: tuple[float, float, float],
    ) -> None:
        """Search the path again, for a robot at arc length `arc` [m] with speed `v` [m/s].

        `pieces` are the standing obstacles. `gap` holds the required gap, and the minimum gap for a robot that is
        already in a narrow place [m]. `limits` are the maximum yaw rate [rad/s], lateral acceleration [m/s^2] and
        speed [m/s] of the robot.
        """
        table, settings, (required_gap, min_gap) = self.table, self._settings, gap
        start = self.node(arc)
        end = min(start + int(settings.look_ahead / table.spacing), len(table) - 1)
        window = slice(start, end + 1)
        comfort = max(settings.comfort, required_gap + 0.01)
        gaps, nearest = self._gaps_along(window, pieces, comfort)
        if gaps[0] < required_gap:
            # A robot that is already in a narrow place may continue through it, at its present distance.
            required_gap = max(min_gap, float(gaps[0]) - 2.0 * _ROUNDING)
        if self.bent or gaps.min() < comfort:
            fixed = min(start + _PINNED + int(abs(v) * _AHEAD / table.spacing), end)
            if end - fixed >= 2 * _STRIDE:
                before = self.offset, self.slope, self.bent, gaps, nearest
                self._search(fixed, end, pieces, required_gap, comfort)
                gaps, nearest = self._gaps_along(window, pieces, comfort)
                if gaps.min() < required_gap - _ROUNDING <= before[3].min():
                    # Keep the previous path if it is free and the new path is blocked after smoothing.
                    self.offset, self.slope, self.bent, gaps, nearest = before
        short = np.flatnonzero(gaps < required_gap - _ROUNDING)
        self.ends, self.blocked_by = math.inf, -1
        if short.size:
            self.ends = float((start + short[0] - 1) * table.spacing)
            self.blocked_by = int(nearest[short[0]])
        self._first, self._gaps = start, gaps
        self._speeds = self._permitted_speeds(window, gaps, required_gap, comfort, limits)

    def _gaps_along(self, window: slice, pieces: Pieces, max_gap: float) -> tuple[FloatArray, FloatArray]:
        poses = self.poses(window)
        gaps, nearest = min_gaps(self._footprint, pieces, poses, np.zeros(len(poses)), max_gap)
        return gaps, nearest.astype(float)

    def _search(self, fixed: int, end: int, pieces: Pieces, required_gap: float, comfort: float) -> None:
        """Search a path from node `fixed` to node `end`, and set it."""
        table, settings = self.table, self._settings
        stations = np.arange(fixed, end + 1, _STRIDE)
        cells = max(1, round(settings.swerve / _STEP))
        start_offset = self.offset[fixed]
        slope = self.slope[fixed] * _STRIDE * table.spacing / _STEP
        path = np.ascontiguousarray(table.pose[stations])
        travel = np.ascontiguousarray(table.travel[stations])
        max_offset = np.where(table.fixed[stations] > 0.0, 0.0, settings.swerve)
        # An offset stays below the radius of curvature.
        max_offset = np.minimum(max_offset, 0.7 / np.maximum(np.abs(table.curvature[stations]), 1e-6))
        previous = np.ascontiguousarray(self.offset[stations])
        offsets = np.zeros(len(stations))
        cost = np.empty(len(stations) * (2 * cells + 1) * _SLOPES)
        cached, origin = np.empty(cost.size), np.zeros(cost.size, dtype=np.intc)
        ffi, lib = load_free_space()
        round_ = ffi.new(
            "ddmpc_round *",
            {
                "stations": len(stations),
                "cells": cells,
                "step": _STEP,
                "spacing": _STRIDE * table.spacing,
                "min_gap": required_gap,
                "comfort": comfort,
                "cell": int(np.clip(round(start_offset / _STEP), -cells, cells)),
                "slope": int(np.clip(round(slope), -_STRAIGHT, _STRAIGHT)),
            },
        )
        reached = lib.ddmpc_find_path(
            self._footprint.struct,
            pieces.struct,
            round_,
            address(path),
            address(travel),
            address(max_offset),
            address(previous),
            address(cost, "real *"),
            address(cached, "real *"),
            address(origin, "int *"),
            address(offsets, "real *"),
        )
        if reached < 2:
            return
        nodes = np.arange(fixed, stations[reached - 1] + 1)
        target = np.interp(nodes, stations[:reached], offsets[:reached])
        self._set_smooth(fixed, target, pieces, required_gap)

    def _set_smooth(self, fixed: int, target: FloatArray, pieces: Pieces, required_gap: float) -> None:
        """Smooth the offsets `target` (k,) from node `fixed` on, as much as the required gap permits, and set them."""
        offset, first = self.offset.copy(), max(fixed - _PINNED + 1, 0)
        pinned = offset[first : fixed + 1]
        self.bent = bool(np.any(offset) or np.any(target))
        last = fixed + len(target)
        for trust in _TRUST:
            new = offset.copy()
            new[fixed + 1 : last] = _smooth(pinned, target[1:], trust)
            new[last:] = new[last - 1]
            new[np.abs(new) < 1e-4] = 0.0
            self.offset = new
            part = slice(max(first - 1, 0), last + 1)
            self.slope = self.slope.copy()
            self.slope[part] = np.gradient(new[part], self.table.spacing)
            self.slope[last:] = 0.0
            gaps, _ = self._gaps_along(slice(fixed + 1, last), pieces, required_gap)
            if gaps.min(initial=math.inf) >= required_gap - _ROUNDING:
                break
        self.bent = bool(np.any(self.offset[first:]))

    def _permitted_speeds(
        self, window: slice, gaps: FloatArray, required_gap: float, comfort: float, limits: tuple[float, float, float]
    ) -> FloatArray:
        """Compute the permitted speed (k,) at each node of the window [m/s], from the gaps and the curvature."""
        settings, (yaw_rate, lateral, max_speed) = self._settings, limits
        room = np.clip((gaps - required_gap) / (comfort - required_gap), 0.0, 1.0)
        slow = min(settings.narrow_speed, max_speed)
        speeds = np.where(room >= 1.0, math.inf, slow + (max_speed - slow) * room)
        if self.bent:
            heading = np.unwrap(self.poses(window)[:, 2])
            bend = np.abs(np.gradient(heading, self.table.spacing)) if len(heading) > 1 else np.zeros(1)
            bend = np.maximum(bend, 1e-6)
            curvature = np.maximum(np.abs(self.table.curvature[window]), 1e-6)
            bend_speeds = np.minimum(yaw_rate / bend, np.sqrt(lateral / bend))
            speeds = np.where(bend > 1.2 * curvature, np.minimum(speeds, bend_speeds), speeds)
        return np.asarray(speeds)

    def speed_now(self, arc: float, end: float) -> float:
        """Compute the maximum present speed for the permitted speeds ahead and a stop at arc length `end` [m/s]."""
        a = self._settings.deceleration
        nodes = (self._first + np.arange(len(self._speeds))) * self.table.spacing
        ahead = np.maximum(nodes - arc, 0.0)
        finite = np.isfinite(self._speeds) & (nodes >= arc - self.table.spacing)
        speed = math.inf
        if finite.any():
            speed = float(np.sqrt(self._speeds[finite] ** 2 + 2.0 * a * ahead[finite]).min())
        if math.isfinite(end):
            speed = min(speed, math.sqrt(2.0 * a * max(0.0, end - arc)))
        return speed


def _smooth(pinned: FloatArray, target: FloatArray, trust: float) -> FloatArray:
    """Return values (k,) near `target` (k,) with small second and third differences, continuing `pinned` (p,)."""
    target_gain, pinned_gain = _smoother(len(pinned), len(target), trust)
    return np.asarray(target_gain @ target + pinned_gain @ pinned)


@cache
def _smoother(pinned: int, free: int, trust: float) -> tuple[FloatArray, FloatArray]:
    """Compute the two matrices of the least-squares solution in `_smooth`."""
    count = pinned + free
    second, third = np.diff(np.eye(count), 2, axis=0), np.diff(np.eye(count), 3, axis=0)
    # The factors scale the differences per node to changes over some ten nodes.
    hessian = 20.0 * _BEND * second.T @ second + 200.0 * _JERK * third.T @ third
    inverse = np.linalg.inv(hessian[pinned:, pinned:] + trust * np.eye(free))
    return np.asarray(trust * inverse, dtype=float), np.asarray(-inverse @ hessian[pinned:, :pinned], dtype=float)


@dataclass(frozen=True, eq=False)
class BentReference:
    """Reference that is shifted to the left by the guide's offsets; implements `models.interface.Reference`."""

    reference: Reference
    guide: Guide

    @property
    def name(self) -> str:
        """Name of the reference."""
        return self.reference.name

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.reference.duration

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate the shifted reference at `times` (n,) [s]; the arc lengths are those of the original reference.

        With the offset l to the left, the curvature k and the direction of travel s = 1 or -1, the point moves at
        v sqrt((1 - s l k)^2 + l'^2) in the direction atan2(s l', 1 - s l k) relative to the heading.
        """
        plain = self.reference.sample(times)
        if not self.guide.bent:
            return plain
        pose, twist, arc = plain
        table = self.guide.table
        offset, slope, bend = _cubic(self.guide.offset, self.guide.slope, table.spacing, arc)
        travel, moves = np.where(twist[:, 0] < 0.0, -1.0, 1.0), np.abs(twist[:, 0]) > STANDING
        node = np.minimum((arc / table.spacing).astype(int), len(table) - 1)
        speed = np.where(moves, np.abs(twist[:, 0]), 1.0)
        travel = np.where(moves, travel, table.travel[node])
        curvature = np.where(moves, twist[:, 1] / speed, table.curvature[node])
        forward = 1.0 - travel * offset * curvature
        rotation = np.arctan2(travel * slope, forward)
        stretch = np.hypot(forward, slope)
        turning = travel * (bend * forward + slope**2 * curvature * travel) / stretch**2
        heading = pose[:, 2]
        x, y = pose[:, 0] - np.sin(heading) * offset, pose[:, 1] + np.cos(heading) * offset
        rate = twist[:, 1] + np.where(moves, turning * speed, 0.0)
        shifted = np.stack([x, y, heading + rotation], axis=1)
        return ReferenceSample(shifted, np.stack([twist[:, 0] * stretch, rate], axis=1), arc)


def _cubic(
    values: FloatArray, slopes: FloatArray, spacing: float, arc_length: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Evaluate a cubic Hermite spline through `values` with `slopes` at each multiple of `spacing`.

    Returns value, slope and second derivative, (n,) each.
    """
    if len(values) < 2:
        return np.full(arc_length.shape, values[0]), np.zeros(arc_length.shape), np.zeros(arc_length.shape)
    place = np.clip(arc_length / spacing, 0.0, len(values) - 1.0)
    i = np.minimum(place.astype(int), len(values) - 2)
    u = place - i
    a, b, m, n = values[i], values[i + 1], spacing * slopes[i], spacing * slopes[i + 1]
    rise = b - a
    value = a + u * (m + u * (3.0 * rise - 2.0 * m - n + u * (m + n - 2.0 * rise)))
    slope = m + u * (2.0 * (3.0 * rise - 2.0 * m - n) + 3.0 * u * (m + n - 2.0 * rise))
    second = 2.0 * (3.0 * rise - 2.0 * m - n) + 6.0 * u * (m + n - 2.0 * rise)
    return value, slope / spacing, second / spacing**2
