"""Buffer of recent transforms by child frame, for lookups along chains of frames at any stored time.

As in tf2, transforms are not extrapolated beyond the newest stamp, and the default time of a lookup is the newest time
at which all transforms of the chain are known. The buffer also detects faults: loops, frames with two alternating
parents, and stamps in the future.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.mpc.ros.transforms.rigid import IDENTITY, Rigid

_SECOND = 1_000_000_000
STORED_TIME = 10 * _SECOND
"""Time for which a transform is stored [ns], equal to that of tf2."""
MAX_FUTURE = 2 * _SECOND
"""Maximum time by which a stamp may be in the future [ns]; AMCL, for instance, post-dates transforms by up to 1 s."""
MAX_FRAMES = 500
MAX_TRANSFORMS = 4000
"""Maximum number of transforms of a frame; above 400 Hz they are stored for less than `STORED_TIME`."""
_NORM_TOLERANCE = 1e-2
_MIN_PARENT_CHANGES = 2
"""Number of parent changes within `STORED_TIME` from which a frame counts as having two parents."""


class TransformError(DiffdriveMpcError, ValueError):
    """Error for an invalid or missing transform, with the reason in one line."""

    def __init__(self, reason: str) -> None:
        super().__init__(plain_line(reason))  # frame names may contain control characters of the terminal


class TransformLookup(NamedTuple):
    """Result of a lookup.

    Attributes
    ----------
    transform
        Transform from coordinates in the source frame to coordinates in the target frame.
    stamp
        Time at which the transform is valid [ns]; None if all transforms of the chain are static.
    oldest
        Frame of the chain with the oldest transform; empty if all transforms are static.
    """

    transform: Rigid
    stamp: int | None
    oldest: str


@dataclass
class _FrameHistory:
    """Transforms of a frame relative to its parent, oldest first; a static transform is valid at all times."""

    parent: str
    static: bool
    stamps: list[int] = field(default_factory=list)
    history: dict[int, Rigid] = field(default_factory=dict)
    changes: list[int] = field(default_factory=list)
    rival_parent: str = ""


class TransformBuffer:
    """Buffer of the transforms on /tf and /tf_static."""

    def __init__(self) -> None:
        self._frames: dict[str, _FrameHistory] = {}

    def clear(self) -> None:
        """Delete all transforms that are not static."""
        self._frames = {name: entry for name, entry in self._frames.items() if entry.static}

    def __len__(self) -> int:
        """Return the number of stored transforms."""
        return sum(len(entry.stamps) or 1 for entry in self._frames.values())

    def insert(self, parent: str, child: str, stamp: int, transform: Rigid, now: int, *, static: bool = False) -> None:
        """Store the transform of `child` in `parent` at `stamp`, received at `now` [ns].

        Raises
        ------
        TransformError
            If the transform is not rigid, too old, in the future, or exceeds the maximum number of frames; the buffer
            then stays unchanged.
        """
        parent, child = parent.removeprefix("/"), child.removeprefix("/")
        link = f"'{parent}' -> '{child}'"
        if not parent or not child or parent == child:
            raise TransformError(f"{link} does not name two different frames")
        norm = math.hypot(*transform[3:])
        if not (all(map(math.isfinite, transform)) and abs(norm - 1.0) <= _NORM_TOLERANCE):
            raise TransformError(f"{link} is not finite, or its rotation is not a unit quaternion")
        if not static and stamp - now > MAX_FUTURE:
            raise TransformError(f"{link} is {(stamp - now) / _SECOND:.1f} s in the future: are the clocks in step?")
        entry = self._frames.get(child)
        if entry is None and len(self._frames) >= MAX_FRAMES:
            raise TransformError(f"{link} exceeds the maximum of {MAX_FRAMES} frames")
        # Record a change of the parent; alternating parents indicate two conflicting publishers.
        if entry is None or (entry.parent, entry.static) != (parent, static):
            changes = (
                [] if entry is None else [*(time for time in entry.changes if abs(now - time) <= STORED_TIME), now]
            )
            entry = _FrameHistory(
                parent,
                static,
                changes=changes[-_MIN_PARENT_CHANGES:],
                rival_parent="" if entry is None else entry.parent,
            )
            self._frames[child] = entry
        unit = Rigid(*transform[:3], *(value / norm for value in transform[3:]))
        if static:
            # Static transforms are stored at the time 0, where `_at` reads them.
            entry.stamps, entry.history = [], {0: unit}
            return
        if entry.stamps and stamp < entry.stamps[-1] - STORED_TIME:
            raise TransformError(f"{link} is {(entry.stamps[-1] - stamp) / _SECOND:.1f} s older than the last")
        if stamp not in entry.history:
            # Transforms may arrive out of order.
            insort(entry.stamps, stamp)
        entry.history[stamp] = unit
        start = bisect_left(entry.stamps, entry.stamps[-1] - STORED_TIME)
        start = max(start, len(entry.stamps) - MAX_TRANSFORMS)
        for old in entry.stamps[:start]:
            del entry.history[old]
        del entry.stamps[:start]

    def lookup(self, target: str, source: str, now: int, time: int | None = None) -> TransformLookup:
        """Look up the transform from `source` to `target` at `time` [ns], by default the newest time of the chain.

        Raises
        ------
        TransformError
            If there is no chain of frames, the chain has a loop or a frame with two parents, or a transform is not
            known at `time`.
        """
        source_chain, target_chain = (self._ancestors(frame.removeprefix("/")) for frame in (source, target))
        common = next((name for name in source_chain if name in target_chain), None)
        if common is None:
            raise TransformError(self._missing_chain(target, source))
        chain = [*source_chain[: source_chain.index(common)], *target_chain[: target_chain.index(common)]]
        moving = []
        for name in chain:
            entry = self._frames[name]
            if len([change for change in entry.changes if abs(now - change) <= STORED_TIME]) >= _MIN_PARENT_CHANGES:
                raise TransformError(
                    f"frame '{name}' has two alternating parents, '{entry.parent}' and '{entry.rival_parent}': "
                    "publish one of them only"
                )
            if not entry.static:
                moving.append((entry.stamps[-1], name))
        # The newest stamps of the transforms differ; all transforms are known up to the oldest of these stamps.
        newest, oldest = min(moving, default=(None, ""))
        stamp = newest if time is None else time
        transform = IDENTITY
        for name in target_chain[: target_chain.index(common)]:
            transform = self._at(name, stamp).after(transform)
        back, transform = transform.inverse(), IDENTITY
        for name in source_chain[: source_chain.index(common)]:
            transform = self._at(name, stamp).after(transform)
        return TransformLookup(back.after(transform), stamp if moving else None, oldest)

    def passes(self, source: str, target: str, frame: str) -> bool:
        """Return True if the chain from `source` to `target` contains `frame`."""
        source_chain, target_chain = self._ancestors(source), self._ancestors(target)
        common = next((name for name in source_chain if name in target_chain), None)
        return common is not None and common != frame and frame in source_chain[: source_chain.index(common)]

    def _ancestors(self, frame: str) -> list[str]:
        """Return `frame`, its parent, and all further ancestors in this order."""
        return list(self._upwards(frame))

    def _upwards(self, frame: str) -> Iterator[str]:
        visited = []
        while frame not in visited:
            visited.append(frame)
            yield frame
            entry = self._frames.get(frame)
            if entry is None:
                return
            frame = entry.parent
        raise TransformError(f"frames loop: {' -> '.join([*visited[visited.index(frame) :], frame])}")

    def _missing_chain(self, target: str, source: str) -> str:
        known_frames = {*self._frames, *(entry.parent for entry in self._frames.values())}
        missing = [name for name in (target, source) if name not in known_frames]
        if missing:
            return f"no transform from '{source}' to '{target}': there is no transform of '{missing[0]}'"
        return f"no transform from '{source}' to '{target}': the frames are not connected"

    def _at(self, name: str, stamp: int | None) -> Rigid:
        entry = self._frames[name]
        if entry.static:
            return entry.history[0]
        stamps = entry.stamps
        assert stamp is not None
        if not stamps[0] <= stamp <= stamps[-1]:
            side, bound = ("after", stamps[-1]) if stamp > stamps[-1] else ("before", stamps[0])
            raise TransformError(
                f"'{entry.parent}' -> '{name}' is unknown at the requested time, {abs(stamp - bound) / _SECOND:.2f} s "
                f"{side} the {'last' if side == 'after' else 'first'} transform"
            )
        right = bisect_left(stamps, stamp)
        end = stamps[right]
        if end == stamp:
            return entry.history[stamp]
        start = stamps[right - 1]
        return entry.history[start].towards(entry.history[end], (stamp - start) / (end - start))
