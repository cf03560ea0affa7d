"""The way around obstacles: shift of the reference to the side, node by node, and its end.

Beyond the horizon the planner sees nothing. So a way is searched along the path as far as `look_ahead`: offsets to the
side by dynamic programming, made smooth, and checked with the footprint at each node. The search starts from the last
way, and a different way has a cost, so the side on which an obstacle is passed does not change without need.
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
from diffdrive_mpc_extras.free_space.pieces import Pieces, PlacedFootprint, address, least_gaps, load_free_space

SPACING = 0.05
"""Between two nodes [m]; wider for a reference of more than `MOST` nodes."""
MOST = 100_000
_MOST_SAMPLES = 100_000
# Nodes nearer than this to a turn on the spot or a cusp are not moved aside [m].
_STAYS = 0.1


@dataclass(frozen=True, eq=False)
class PathTable:
    """The nodes of a path.

    Attributes
    ----------
    spacing
        Between two of them [m].
    pose
        (m, 3), theta unwrapped.
    travel
        (m,) 1 where it drives forwards, -1 backwards.
    curvature
        (m,) of the heading by distance [rad/m].
    speed
        (m,) of the reference [m/s].
    fixed
        (m,) whether a node must stay on the reference: the end, and where it turns on the spot or changes its
        direction.
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
        times = np.linspace(0.0, reference.duration, min(int(reference.duration / 0.02) + 2, _MOST_SAMPLES))
        sample = reference.sample(times)
        arc, v, omega = sample.arc_length, sample.twist[:, 0], sample.twist[:, 1]
        spacing = max(SPACING, float(arc[-1]) / MOST)
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
        stays = np.concatenate([arc[turns], moving_arc[cusps], arc[-1:]])
        near = np.searchsorted(np.sort(stays), nodes)
        stays = np.concatenate([[-np.inf], np.sort(stays), [np.inf]])
        fixed = np.minimum(nodes - stays[near], stays[near + 1] - nodes) <= _STAYS
        return cls(spacing, pose, travel, curvature, speed, fixed.astype(float))

    def __len__(self) -> int:
        """Return the number of nodes."""
        return len(self.pose)


_STEP = 0.025  # between two offsets that are tried [m]: a doorway leaves some 4 cm
_STRIDE = 2  # nodes from one station of the search to the next
_SLOPES, _STRAIGHT = 9, 4
# Costs of a smooth way by node: for its bend and its change, in addition to the distance from the way found.
_BEND, _JERK = 0.02, 0.02
_TRUST = (0.02, 0.2, 2.0, 20.0)
# Nodes of the way that are never changed: the robot is there.
_KEPT = 3
# Time before a change of the way is reached [s]: the controller's plan follows it already.
_AHEAD = 0.4
_ROUNDING = 0.001  # a gap that is too narrow by at most this is wide enough [m]


class Guide:
    """The way around obstacles along one reference.

    Parameters
    ----------
    table
        The reference's nodes.
    footprint
        The robot's.
    settings
        Range of the search, and largest shift of a node.

    Attributes
    ----------
    offset
        (m,) by how much each node is moved to the left of its heading [m].
    slope
        (m,) its change by arc length.
    bent
        Whether any node is moved.
    ends
        Arc length at which the way ends; infinity where it does not [m].
    blocked_by
        The piece that ends it, -1: none.
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
        """Return poses (k, 3) of the moved path at some nodes."""
        table, offset = self.table, self.offset
        pose, travel = table.pose[nodes], table.travel[nodes]
        if not self.bent:
            return np.ascontiguousarray(pose)
        slope, moved = self.slope[nodes], offset[nodes]
        turned = np.arctan2(travel * slope, 1.0 - travel * moved * table.curvature[nodes])
        return np.stack(
            [
                pose[:, 0] - np.sin(pose[:, 2]) * moved,
                pose[:, 1] + np.cos(pose[:, 2]) * moved,
                pose[:, 2] + turned,
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
        top: tuple[float, float, float],
    ) -> None:
        """Search the path again for a robot at arc length `arc` [m] with speed `v` [m/s].

        `pieces` stand; `gap` is what the way needs, and the least where it is in a narrow place [m]; `top` are the
        largest yaw rate [rad/s], lateral acceleration [m/s^2] and speed [m/s] of the robot.
        """
        table, settings, (keeps, least) = self.table, self._settings, gap
        start = self.node(arc)
        end = min(start + int(settings.look_ahead / table.spacing), len(table) - 1)
        window = slice(start, end + 1)
        comfort = max(settings.comfort, keeps + 0.01)
        gaps, nearest = self._gaps_along(window, pieces, comfort)
        if gaps[0] < keeps:
            # A robot that is already in a narrow place may continue through it, at its present distance.
            keeps = max(least, float(gaps[0]) - 2.0 * _ROUNDING)
        if self.bent or gaps.min() < comfort:
            fixed = min(start + _KEPT + int(abs(v) * _AHEAD / table.spacing), end)
            if end - fixed >= 2 * _STRIDE:
                before = self.offset, self.slope, self.bent, gaps, nearest
                self._seek(fixed, end, pieces, keeps, comfort)
                gaps, nearest = self._gaps_along(window, pieces, comfort)
                if gaps.min() < keeps - _ROUNDING <= before[3].min():
                    # The previous way is free; the new one, after smoothing, is not.
                    self.offset, self.slope, self.bent, gaps, nearest = before
        short = np.flatnonzero(gaps < keeps - _ROUNDING)
        self.ends, self.blocked_by = math.inf, -1
        if short.size:
            self.ends = float((start + short[0] - 1) * table.spacing)
            self.blocked_by = int(nearest[short[0]])
        self._first, self._gaps = start, gaps
        self._speeds = self._allowed(window, gaps, keeps, comfort, top)

    def _gaps_along(self, window: slice, pieces: Pieces, enough: float) -> tuple[FloatArray, FloatArray]:
        poses = self.poses(window)
        gaps, nearest = least_gaps(self._footprint, pieces, poses, np.zeros(len(poses)), enough)
        return gaps, nearest.astype(float)

    def _seek(self, fixed: int, end: int, pieces: Pieces, keeps: float, comfort: float) -> None:
        """Search the path from node `fixed` to `end`."""
        table, settings = self.table, self._settings
        stations = np.arange(fixed, end + 1, _STRIDE)
        cells = max(1, round(settings.swerve / _STEP))
        begins = self.offset[fixed]
        slope = self.slope[fixed] * _STRIDE * table.spacing / _STEP
        path = np.ascontiguousarray(table.pose[stations])
        travel = np.ascontiguousarray(table.travel[stations])
        most = np.where(table.fixed[stations] > 0.0, 0.0, settings.swerve)
        # A centre of curvature is not reached.
        most = np.minimum(most, 0.7 / np.maximum(np.abs(table.curvature[stations]), 1e-6))
        before = np.ascontiguousarray(self.offset[stations])
        offsets = np.zeros(len(stations))
        cost = np.empty(len(stations) * (2 * cells + 1) * _SLOPES)
        known, origin = np.empty(cost.size), np.zeros(cost.size, dtype=np.intc)
        ffi, lib = load_free_space()
        round_ = ffi.new(
            "ddmpc_round *",
            {
                "stations": len(stations),
                "cells": cells,
                "step": _STEP,
                "spacing": _STRIDE * table.spacing,
                "least": keeps,
                "comfort": comfort,
                "cell": int(np.clip(round(begins / _STEP), -cells, cells)),
                "slope": int(np.clip(round(slope), -_STRAIGHT, _STRAIGHT)),
            },
        )
        reached = lib.ddmpc_way_round(
            self._footprint.struct,
            pieces.struct,
            round_,
            address(path),
            address(travel),
            address(most),
            address(before),
            address(cost, "real *"),
            address(known, "real *"),
            address(origin, "int *"),
            address(offsets, "real *"),
        )
        if reached < 2:
            return
        nodes = np.arange(fixed, stations[reached - 1] + 1)
        wanted = np.interp(nodes, stations[:reached], offsets[:reached])
        self._take_smooth(fixed, wanted, pieces, keeps)

    def _take_smooth(self, fixed: int, wanted: FloatArray, pieces: Pieces, keeps: float) -> None:
        """Take the smoothest of some ways near `wanted` (k,), from node `kept` on, along which there is room."""
        offset, first = self.offset.copy(), max(fixed - _KEPT + 1, 0)
        pinned = offset[first : fixed + 1]
        self.bent = bool(np.any(offset) or np.any(wanted))
        last = fixed + len(wanted)
        for trust in _TRUST:
            new = offset.copy()
            new[fixed + 1 : last] = _smooth(pinned, wanted[1:], trust)
            new[last:] = new[last - 1]
            new[np.abs(new) < 1e-4] = 0.0
            self.offset = new
            part = slice(max(first - 1, 0), last + 1)
            self.slope = self.slope.copy()
            self.slope[part] = np.gradient(new[part], self.table.spacing)
            self.slope[last:] = 0.0
            gaps, _ = self._gaps_along(slice(fixed + 1, last), pieces, keeps)
            if gaps.min(initial=math.inf) >= keeps - _ROUNDING:
                break
        self.bent = bool(np.any(self.offset[first:]))

    def _allowed(
        self, window: slice, gaps: FloatArray, keeps: float, comfort: float, top: tuple[float, float, float]
    ) -> FloatArray:
        """Compute the permitted speed (k,) at each node of the window [m/s]."""
        settings, (turn, lateral, fastest) = self._settings, top
        room = np.clip((gaps - keeps) / (comfort - keeps), 0.0, 1.0)
        slow = min(settings.narrow_speed, fastest)
        speeds = np.where(room >= 1.0, math.inf, slow + (fastest - slow) * room)
        if self.bent:
            heading = np.unwrap(self.poses(window)[:, 2])
            bend = np.abs(np.gradient(heading, self.table.spacing)) if len(heading) > 1 else np.zeros(1)
            bend = np.maximum(bend, 1e-6)
            curvature = np.maximum(np.abs(self.table.curvature[window]), 1e-6)
            by_bend = np.minimum(turn / bend, np.sqrt(lateral / bend))
            speeds = np.where(bend > 1.2 * curvature, np.minimum(speeds, by_bend), speeds)
        return np.asarray(speeds)

    def speed_now(self, arc: float, ends: float) -> float:
        """Compute the speed along the path for a stop at arc length `ends` and slow passage of narrow places [m/s]."""
        a = self._settings.deceleration
        nodes = (self._first + np.arange(len(self._speeds))) * self.table.spacing
        ahead = np.maximum(nodes - arc, 0.0)
        finite = np.isfinite(self._speeds) & (nodes >= arc - self.table.spacing)
        most = math.inf
        if finite.any():
            most = float(np.sqrt(self._speeds[finite] ** 2 + 2.0 * a * ahead[finite]).min())
        if math.isfinite(ends):
            most = min(most, math.sqrt(2.0 * a * max(0.0, ends - arc)))
        return most


def _smooth(pinned: FloatArray, wanted: FloatArray, trust: float) -> FloatArray:
    """Smooth (k,) numbers after `pinned` (p,): near `wanted` (k,), with small second and third differences."""
    by_wanted, by_pinned = _smoother(len(pinned), len(wanted), trust)
    return np.asarray(by_wanted @ wanted + by_pinned @ pinned)


@cache
def _smoother(pinned: int, free: int, trust: float) -> tuple[FloatArray, FloatArray]:
    """Compute the matrices of the least squares in `_smooth`."""
    count = pinned + free
    second, third = np.diff(np.eye(count), 2, axis=0), np.diff(np.eye(count), 3, axis=0)
    # Differences in units of nodes: of numbers that bend over some ten nodes.
    whole = 20.0 * _BEND * second.T @ second + 200.0 * _JERK * third.T @ third
    inverse = np.linalg.inv(whole[pinned:, pinned:] + trust * np.eye(free))
    return np.asarray(trust * inverse, dtype=float), np.asarray(-inverse @ whole[pinned:, :pinned], dtype=float)


@dataclass(frozen=True, eq=False)
class BentReference:
    """Satisfies `models.interface.Reference`: `reference` on its own time, moved to the left by the guide's offsets."""

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
        """Evaluate at `times` (n,) [s]; arc lengths stay those of the reference.

        With the offset l to the left and the curvature k, along the travel s = 1 or -1: the point moves at
        v sqrt((1 - s l k)^2 + l'^2), in the direction atan2(s l', 1 - s l k) from the heading.
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
        turned = np.arctan2(travel * slope, forward)
        stretch = np.hypot(forward, slope)
        turning = travel * (bend * forward + slope**2 * curvature * travel) / stretch**2
        heading = pose[:, 2]
        x, y = pose[:, 0] - np.sin(heading) * offset, pose[:, 1] + np.cos(heading) * offset
        rate = twist[:, 1] + np.where(moves, turning * speed, 0.0)
        moved = np.stack([x, y, heading + turned], axis=1)
        return ReferenceSample(moved, np.stack([twist[:, 0] * stretch, rate], axis=1), arc)


def _cubic(
    values: FloatArray, slopes: FloatArray, spacing: float, arc_length: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Evaluate cubics through `values` with `slopes` every `spacing`: value, slope and second derivative (n,)."""
    if len(values) < 2:
        return np.full(arc_length.shape, values[0]), np.zeros(arc_length.shape), np.zeros(arc_length.shape)
    place = np.clip(arc_length / spacing, 0.0, len(values) - 1.0)
    i = np.minimum(place.astype(int), len(values) - 2)
    u = place - i
    a, b, m, n = values[i], values[i + 1], spacing * slopes[i], spacing * slopes[i + 1]
    rise = b - a
    # Hermite's cubic
    value = a + u * (m + u * (3.0 * rise - 2.0 * m - n + u * (m + n - 2.0 * rise)))
    slope = m + u * (2.0 * (3.0 * rise - 2.0 * m - n) + 3.0 * u * (m + n - 2.0 * rise))
    second = 2.0 * (3.0 * rise - 2.0 * m - n) + 6.0 * u * (m + n - 2.0 * rise)
    return value, slope / spacing, second / spacing**2
