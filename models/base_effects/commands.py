"""What a base makes of the twist it is commanded: slopes that it follows; steps, coasting, top speed of its wheels."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray


class TwistSlew(StrictModel):
    """Slope limits of the commanded twist inside the base, each channel on its own.

    A controller whose own slew limits are no wider never meets them, and its linear model then holds.
    """

    v: float = Field(gt=0, description="largest slope of v_ref that the base follows [m/s^2]")
    omega: float = Field(gt=0, description="largest slope of omega_ref that the base follows [rad/s^2]")

    def step(self, previous: ArrayLike, command: ArrayLike, dt: float) -> FloatArray:
        """Twist (..., 2) that the base has reached `dt` seconds after `previous` on its way to `command`."""
        before = np.asarray(previous, dtype=float)
        reach = np.array([self.v, self.omega]) * dt
        return np.asarray(before + np.clip(np.asarray(command, dtype=float) - before, -reach, reach))

    def follow(self, commands: ArrayLike, dt: float, start: ArrayLike) -> FloatArray:
        """Twists (K, 2) inside the base after each sample of `dt` [s] under `commands` (K, 2), from `start` (2,)."""
        commands = np.asarray(commands, dtype=float)
        columns = [
            _ramps(column, limit * dt, float(first))
            for column, limit, first in zip(
                commands.T, (self.v, self.omega), np.asarray(start, dtype=float), strict=True
            )
        ]
        return np.stack(columns, axis=-1)


def _ramps(commands: FloatArray, reach: float, start: float) -> FloatArray:
    """(K,) what follows `commands` (K,) by at most `reach` a sample: one ramp for each run of equal commands."""
    if not len(commands):
        return np.empty(0)
    first = np.flatnonzero(np.concatenate([[True], np.diff(commands) != 0]))
    counts = np.diff(np.append(first, len(commands)))
    missing = np.empty(len(first))
    last = start
    # Plain numbers: a log may well change its command at every sample.
    for run, (target, count) in enumerate(zip(commands[first].tolist(), counts.tolist(), strict=True)):
        gap = last - target
        missing[run] = gap
        left = abs(gap) - reach * count
        last = target + (left if gap > 0 else -left) if left > 0 else target
    passed = np.arange(len(commands)) - np.repeat(first, counts) + 1
    gap = np.repeat(missing, counts)
    return np.asarray(commands + np.sign(gap) * np.maximum(np.abs(gap) - reach * passed, 0.0))


# A speed this close below a step, in steps, counts as on it: it came from rounded decimals.
_ON_STEP = 1e-9


class WheelCommand(StrictModel):
    """Static map of a base that turns (v, omega) into one rim speed for each side.

    Rim speeds are cut to `top_speed` and towards zero to whole steps of `resolution`. A side asked for less than one
    step is not held: it rolls along with the other side, up to `coasting_speed`. Observed on a Husky A200: with one
    side asked for less than 0.01 m/s, its wheels turned with the other side's up to 0.5 rad/s.
    """

    track: float = Field(gt=0, description="track by which the base turns omega_ref into rim speeds [m]")
    resolution: float = Field(default=0.0, ge=0, description="step of the commanded rim speed, cut towards zero [m/s]")
    coasting_speed: float = Field(
        default=0.0, ge=0, description="rim speed up to which an unheld side rolls along [m/s]"
    )
    top_speed: float | None = Field(default=None, gt=0, description="rim speed that the motors can reach [m/s]")

    @model_validator(mode="after")
    def _reachable(self) -> WheelCommand:
        if self.top_speed is not None and self.top_speed < self.resolution:
            raise ValueError(
                f"top_speed {self.top_speed} m/s is less than one step of resolution ({self.resolution} m/s)"
            )
        return self

    def sides(self, twist: ArrayLike) -> FloatArray:
        """Rim speeds (..., 2) left, right [m/s] of twists (..., 2) v [m/s], omega [rad/s]."""
        v, omega = np.moveaxis(np.asarray(twist, dtype=float), -1, 0)
        half = 0.5 * self.track * omega
        return np.stack([v - half, v + half], axis=-1)

    def twist(self, sides: ArrayLike) -> FloatArray:
        """Twists (..., 2) of rim speeds (..., 2): the exact inverse of `sides`."""
        left, right = np.moveaxis(np.asarray(sides, dtype=float), -1, 0)
        return np.stack([0.5 * (left + right), (right - left) / self.track], axis=-1)

    def apply(self, twist: ArrayLike) -> FloatArray:
        """Twists (..., 2) that the motors are asked for, in the units of the command."""
        held = self._held(self.sides(twist))
        along = np.clip(held[..., ::-1], -self.coasting_speed, self.coasting_speed)
        return self.twist(np.where(self.coasts(twist), along, held))

    def coasts(self, twist: ArrayLike) -> NDArray[np.bool_]:
        """Whether the left, right side (..., 2) is asked for less than one step while the other is driven."""
        held = self._held(self.sides(twist))
        return np.asarray((held == 0.0) & (held[..., ::-1] != 0.0), dtype=np.bool_)

    def invert(self, twist: ArrayLike) -> FloatArray:
        """Commands (..., 2) for which the motors are asked for `twist`, to half a step on each side.

        A twist made of whole steps is met exactly. Speeds above `top_speed` become it; coasting cannot be inverted.
        """
        sides = self._cut(self.sides(twist))
        # The middle of the step whose cut value is nearest.
        return self.twist(sides + 0.5 * self.resolution * np.sign(sides))

    def slope(self, twist: ArrayLike) -> FloatArray:
        """(..., 2, 2) derivative of `apply` with the steps smoothed out, for a linearisation at `twist`."""
        speeds = self.sides(twist)
        free = np.ones(speeds.shape) if self.top_speed is None else (np.abs(speeds) < self.top_speed).astype(float)
        coasts = self.coasts(twist)
        along = coasts * free[..., ::-1] * (np.abs(self._held(speeds)[..., ::-1]) < self.coasting_speed)
        by_side = np.zeros((*speeds.shape, 2))
        for side, other in ((0, 1), (1, 0)):
            by_side[..., side, side] = np.where(coasts[..., side], 0.0, free[..., side])
            by_side[..., side, other] = along[..., side]
        half = 0.5 * self.track
        into, out = np.array([[1.0, -half], [1.0, half]]), np.array([[0.5, 0.5], [-1 / self.track, 1 / self.track]])
        return np.asarray(out @ by_side @ into)

    def _cut(self, sides: FloatArray) -> FloatArray:
        return sides if self.top_speed is None else np.clip(sides, -self.top_speed, self.top_speed)

    def _held(self, sides: FloatArray) -> FloatArray:
        """Rim speeds cut to top speed and to whole steps towards zero."""
        cut = self._cut(sides)
        if self.resolution == 0.0:
            return cut
        return np.sign(cut) * np.floor(np.abs(cut) / self.resolution + _ON_STEP) * self.resolution
