"""Buffer of the transforms of the last seconds by child frame, for lookups along chains of frames at any stored time.

As in tf2, transforms are not extrapolated beyond their newest stamp, and the default time of a lookup is the newest
time that all transforms of the chain have. The buffer also reports faults: loops, frames with two alternating parents,
stamps in the future.
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
"""Time for which a transform is stored [ns], as in tf2."""
MAX_FUTURE = 2 * _SECOND
"""Maximum time of a stamp in the future [ns]; localisations post-date their transforms, AMCL by up to a second."""
MAX_FRAMES = 500
MAX_TRANSFORMS = 4000
"""Maximum number of transforms of one frame; a frame beyond 400 Hz is stored for a shorter time."""
_NORM_TOLERANCE = 1e-2
_DISPUTED = 2
"""Number of parent changes within `STORED_TIME` from which a frame counts as having two parents."""


class TransformError(DiffdriveMpcError, ValueError):
    """A transform is unusable or missing; the error text is the reason in one line."""

    def __init__(self, reason: str) -> None:
        super().__init__(plain_line(reason))  # frame names are untrusted text, and logs are shown in terminals


class TransformLookup(NamedTuple):
    """Result of a lookup.

    Attributes
    ----------
    transform
        Transform from coordinates of the source frame to those of the target frame.
    stamp
        Time at which the transform is valid [ns]; None if all transforms of the chain are static.
    oldest
        Frame of the chain with the oldest transform; empty if all are static.
    """

    transform: Rigid
    stamp: int | None
    oldest: str


@dataclass
class _Placed:
    """Placement of one frame: parent and transforms, oldest first; a static transform is valid at all times."""

    parent: str
    static: bool
    stamps: list[int] = field(default_factory=list)
    history: dict[int, Rigid] = field(default_factory=dict)
    changes: list[int] = field(default_factory=list)
    rival_parent: str = ""


class TransformBuffer:
    """Buffer of the transforms on /tf and /tf_static."""

    def __init__(self) -> None:
        self._frames: dict[str, _Placed] = {}

    def clear(self) -> None:
        """Delete moving transforms, after the clock was set back; static transforms stay."""
        self._frames = {name: placed for name, placed in self._frames.items() if placed.static}

    def __len__(self) -> int:
        """Return the number of stored transforms."""
        return sum(len(placed.stamps) or 1 for placed in self._frames.values())

    def insert(self, parent: str, child: str, stamp: int, transform: Rigid, now: int, *, static: bool = False) -> None:
        """Store the transform of `child` in `parent` at `stamp`, received at `now` [ns].

        Raises
        ------
        TransformError
            If it is not a rigid transform, older than the buffer, in the future, or of too many frames. The buffer is
            then unchanged.
        """
        parent, child = parent.removeprefix("/"), child.removeprefix("/")
        link = f"'{parent}' -> '{child}'"
        if not parent or not child or parent == child:
            raise TransformError(f"{link} names no two frames")
        norm = math.hypot(*transform[3:])
        if not (all(map(math.isfinite, transform)) and abs(norm - 1.0) <= _NORM_TOLERANCE):
            raise TransformError(f"{link} is not finite, or its rotation is not a unit quaternion")
        if not static and stamp - now > MAX_FUTURE:
            raise TransformError(f"{link} is {(stamp - now) / _SECOND:.1f} s in the future: are the clocks in step?")
        placed = self._frames.get(child)
        if placed is None and len(self._frames) >= MAX_FRAMES:
            raise TransformError(f"{link} is one frame too many: the limit is {MAX_FRAMES}")
        # A different parent is a change; alternating parents indicate two conflicting publishers.
        if placed is None or (placed.parent, placed.static) != (parent, static):
            changes = (
                [] if placed is None else [*(time for time in placed.changes if abs(now - time) <= STORED_TIME), now]
            )
            placed = _Placed(
                parent, static, changes=changes[-_DISPUTED:], rival_parent="" if placed is None else placed.parent
            )
            self._frames[child] = placed
        unit = Rigid(*transform[:3], *(value / norm for value in transform[3:]))
        if static:
            placed.stamps, placed.history = [], {0: unit}
            return
        if placed.stamps and stamp < placed.stamps[-1] - STORED_TIME:
            raise TransformError(f"{link} is {(placed.stamps[-1] - stamp) / _SECOND:.1f} s older than the last")
        if stamp not in placed.history:
            insort(placed.stamps, stamp)
        placed.history[stamp] = unit
        start = bisect_left(placed.stamps, placed.stamps[-1] - STORED_TIME)
        start = max(start, len(placed.stamps) - MAX_TRANSFORMS)
        for old in placed.stamps[:start]:
            del placed.history[old]
        del placed.stamps[:start]

    def lookup(self, target: str, source: str, now: int, time: int | None = None) -> TransformLookup:
        """Look up the transform from `source` to `target` at `time` [ns]; None: the newest time of the whole chain.

        Raises
        ------
        TransformError
            If there is no chain of frames, if it has a loop or a frame with two parents, or if a transform is not known
            at that time.
        """
        up, down = self._ancestors(source.removeprefix("/")), self._ancestors(target.removeprefix("/"))
        common = next((name for name in up if name in down), None)
        if common is None:
            raise TransformError(self._missing_chain(target, source))
        chain = [*up[: up.index(common)], *down[: down.index(common)]]
        moving = []
        for name in chain:
            placed = self._frames[name]
            if len([change for change in placed.changes if abs(now - change) <= STORED_TIME]) >= _DISPUTED:
                raise TransformError(
                    f"frame '{name}' is placed in '{placed.parent}' and in '{placed.rival_parent}' by turns: "
                    "it needs one parent"
                )
            if not placed.static:
                moving.append((placed.stamps[-1], name))
        newest, oldest = min(moving, default=(None, ""))
        stamp = newest if time is None else time
        transform = IDENTITY
        for name in down[: down.index(common)]:
            transform = self._at(name, stamp).after(transform)
        back, transform = transform.inverse(), IDENTITY
        for name in up[: up.index(common)]:
            transform = self._at(name, stamp).after(transform)
        return TransformLookup(back.after(transform), stamp if moving else None, oldest)

    def passes(self, source: str, target: str, frame: str) -> bool:
        """Return True if the chain from `source` to `target` contains `frame`."""
        up, down = self._ancestors(source), self._ancestors(target)
        common = next((name for name in up if name in down), None)
        return common is not None and common != frame and frame in up[: up.index(common)]

    def _ancestors(self, frame: str) -> list[str]:
        """List `frame`, its parent, and so on."""
        return list(self._upwards(frame))

    def _upwards(self, frame: str) -> Iterator[str]:
        visited = []
        while frame not in visited:
            visited.append(frame)
            yield frame
            placed = self._frames.get(frame)
            if placed is None:
                return
            frame = placed.parent
        raise TransformError(f"frames loop: {' -> '.join([*visited[visited.index(frame) :], frame])}")

    def _missing_chain(self, target: str, source: str) -> str:
        known = {*self._frames, *(placed.parent for placed in self._frames.values())}
        missing = [name for name in (target, source) if name not in known]
        if missing:
            return f"no transform from '{source}' to '{target}': there is no transform of '{missing[0]}'"
        return f"no transform from '{source}' to '{target}': no chain of frames leads from one to the other"

    def _at(self, name: str, stamp: int | None) -> Rigid:
        placed = self._frames[name]
        if placed.static:
            return placed.history[0]
        stamps = placed.stamps
        assert stamp is not None
        if not stamps[0] <= stamp <= stamps[-1]:
            side, bound = ("after", stamps[-1]) if stamp > stamps[-1] else ("before", stamps[0])
            raise TransformError(
                f"'{placed.parent}' -> '{name}' is not known at that time: it is {abs(stamp - bound) / _SECOND:.2f} s "
                f"{side} the {'last' if side == 'after' else 'first'} transform"
            )
        right = bisect_left(stamps, stamp)
        after = stamps[right]
        if after == stamp:
            return placed.history[stamp]
        before = stamps[right - 1]
        return placed.history[before].towards(placed.history[after], (stamp - before) / (after - before))
