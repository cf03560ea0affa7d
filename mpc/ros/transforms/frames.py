"""Use of transforms: pose of the robot, and placement of references in other frames."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.ros.transforms.buffer import TransformBuffer, TransformError
from diffdrive_mpc.mpc.ros.transforms.rigid import Rigid

_SECOND = 1e9


class Frames:
    """Transforms relative to the control frame.

    Parameters
    ----------
    control, base
        Names of the control frame and of the base frame of the robot.
    timeout
        Maximum age of a transform [s].
    clock
        The node's clock [ns].

    Attributes
    ----------
    buffer
        Received transforms.
    accepted, refused
        Numbers of accepted and refused transforms.
    last_refusal
        Reason for the last refusal; empty if no transform was refused.
    """

    def __init__(self, control: str, base: str, timeout: float, clock: Callable[[], int]) -> None:
        self.control, self._base, self._timeout, self._clock = control, base, timeout, clock
        self.buffer = TransformBuffer()
        self.accepted = self.refused = 0
        self.last_refusal = ""

    def store(self, parent: str, child: str, stamp: int, transform: Rigid, *, static: bool) -> None:
        """Store a transform with its stamp [ns], or count it as refused if it is invalid."""
        try:
            self.buffer.insert(parent, child, stamp, transform, self._clock(), static=static)
        except TransformError as error:
            self.refuse(str(error))
        else:
            self.accepted += 1

    def refuse(self, reason: str) -> None:
        """Count an invalid transform and store the reason."""
        self.refused += 1
        self.last_refusal = reason

    def pose(self) -> tuple[FloatArray, int]:
        """Return the newest pose (3,) x, y [m], yaw [rad] of the robot, and its stamp [ns].

        Raises
        ------
        TransformError
            If the transform is unknown or static.
        """
        transform = self.buffer.lookup(self.control, self._base, self._clock())
        if transform.stamp is None:
            raise TransformError(f"'{self.control}' -> '{self._base}' is static; publish it on /tf")
        return transform.transform.planar, transform.stamp

    def oldest(self) -> str:
        """Return the frame of the robot's chain with the oldest transform; empty if there is no chain."""
        try:
            return self.buffer.lookup(self.control, self._base, self._clock()).oldest
        except TransformError:
            return ""

    def placement(self, frame: str, stamp: int) -> Placement | None:
        """Return the placement of a reference in `frame` at `stamp` [ns]; None if `frame` is the control frame.

        A stamp of 0 is the current time.

        Raises
        ------
        TransformError
            If the position of `frame` is unknown.
        """
        frame = frame.removeprefix("/")
        return None if frame == self.control else Placement(self, frame, stamp, self._base, self._timeout, self._clock)


def moved_poses(poses: FloatArray, motion: FloatArray) -> FloatArray:
    """Rotate poses (n, 3) by the angle of `motion` (3,) about the origin, then translate them."""
    x, y, theta = motion
    cos, sin = np.cos(theta), np.sin(theta)
    return np.column_stack(
        [
            x + cos * poses[:, 0] - sin * poses[:, 1],
            y + sin * poses[:, 0] + cos * poses[:, 1],
            theta + poses[:, 2],
        ]
    )


class Placement:
    """Placement of a reference in a frame that differs from the control frame.

    A frame that moves with the robot, such as its base, is looked up once at the stamp of the reference, so the
    reference is relative to the pose of the robot at that time. All other frames are fixed to the world, like the
    reference. They are looked up at each call of `motion`, since the control frame drifts relative to the world and
    jumps after a localisation update.

    Raises
    ------
    TransformError
        If the position of the frame is unknown.
    """

    def __init__(
        self, frames: Frames, frame: str, stamp: int, base: str, timeout: float, clock: Callable[[], int]
    ) -> None:
        self._frames, self.frame, self._timeout, self._clock = frames, frame, timeout, clock
        self._fixed: FloatArray | None = None
        if frames.buffer.passes(frame, frames.control, base) or frame == base:
            transform = frames.buffer.lookup(frames.control, frame, clock(), stamp or None)
            self._fixed = transform.transform.planar
        else:
            self.motion()

    def motion(self) -> FloatArray:
        """Return the motion (3,): translation x, y [m] after the rotation theta [rad].

        Raises
        ------
        TransformError
            If the transform is unknown or too old.
        """
        if self._fixed is not None:
            return self._fixed
        now = self._clock()
        transform = self._frames.buffer.lookup(self._frames.control, self.frame, now)
        age = 0.0 if transform.stamp is None else (now - transform.stamp) / _SECOND
        if age > self._timeout:
            raise TransformError(
                f"the transform of '{self.frame}' in '{self._frames.control}' is {age:.2f} s old, the limit is "
                f"{self._timeout:g} s (frame '{transform.oldest}')"
            )
        return transform.transform.planar
