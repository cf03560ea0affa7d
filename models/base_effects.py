"""Effects around the linear dynamics of a real base: limits of the command before them, slip after them.

`TwistRange`, `TwistSlew` and `WheelCommand` precede the velocity model; `YawRelaxation` and `Veer` follow it.
`PoseMount` is the position of the pose sensor. Each is optional; `BaseEffects` is their group in a model file, and
`respond` applies them in this order.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.two_sided import BaseSlewLimit, BaseVelocityLimit, BaseYawRateLimit, reached, sides_of
from diffdrive_mpc.models.velocity_model import VelocityModel

# A rate that no command of a robot needs [m/s^2 or rad/s^2].
_AT_ONCE = 1e6
# A speed this close below a step, in steps, counts as on it: it came from rounded decimals.
_ON_STEP = 1e-9
KINDS = ("upper", "lower", "accelerate", "brake")
"""Largest command above and below zero [units of the input]; rates at which its size grows and falls [the same / s]."""
PARTS = 4
"""Inside a sample the base ramps; its limited command is held over this fraction of a sample."""


class TwistSlew(StrictModel):
    """Slope limits of the commanded twist inside the base, each channel on its own; one left out has no limit.

    A controller whose own slew limits are no wider never meets them, and its linear model then holds.
    """

    v: BaseSlewLimit | None = Field(
        default=None,
        description="largest slope of v_ref that the base follows; a number, or {accelerate, brake} [m/s^2]",
    )
    omega: BaseSlewLimit | None = Field(
        default=None,
        description="largest slope of omega_ref that the base follows; a number, or {accelerate, brake} [rad/s^2]",
    )

    @property
    def _rates(self) -> FloatArray:
        """(2, 2) largest rate at which the size of v, omega grows and falls; finite, so that ramps have a duration."""
        limits = (sides_of(np.inf if limit is None else limit) for limit in (self.v, self.omega))
        return np.minimum(list(limits), _AT_ONCE)

    def step(self, previous: ArrayLike, command: ArrayLike, dt: float) -> FloatArray:
        """Return the twist (..., 2) that the base reaches `dt` seconds after `previous` on the path to `command`."""
        return reached(np.asarray(previous, dtype=float), np.asarray(command, dtype=float), *self._rates.T * dt)

    def follow(self, commands: ArrayLike, dt: float, start: ArrayLike) -> FloatArray:
        """Return twists (K, 2) inside the base after samples of `dt` [s] under `commands` (K, 2), from `start` (2,)."""
        columns = zip(np.asarray(commands, dtype=float).T, self._rates, np.asarray(start, dtype=float), strict=True)
        return np.stack([ramps(column, rates * dt, float(first)) for column, rates, first in columns], axis=-1)


def ramps(commands: FloatArray, rates: FloatArray, start: float) -> FloatArray:
    """Return what follows commands (K,) from `start`, its size growing and falling by at most `rates` (2,) a sample.

    One ramp for each run of equal commands, in samples: a position on the way is the number of samples from zero.
    """
    if not len(commands):
        return np.empty(0)
    first = np.flatnonzero(np.concatenate([[True], np.diff(commands) != 0]))
    counts = np.diff(np.append(first, len(commands)))
    grows, falls = rates.tolist()
    befores, last, near = [], start, min(grows, falls)
    # Plain numbers: a log may well change its command at every sample.
    for target, count in zip(commands[first].tolist(), counts.tolist(), strict=True):
        befores.append(last)
        change = target - last
        if -near * count <= change <= near * count:
            last = target
            continue
        above, below = (grows, falls) if change > 0 else (falls, grows)
        end = target / (above if target > 0 else below)
        gap = last / (above if last > 0 else below) - end
        left = abs(gap) - count
        position = end + (left if gap > 0 else -left)
        last = position * (above if position > 0 else below) if left > 0 else target
    before = np.repeat(befores, counts)
    above, below = np.where(commands > before, [[grows], [falls]], [[falls], [grows]])
    end = commands / np.where(commands > 0, above, below)
    gap = before / np.where(before > 0, above, below) - end
    left = np.abs(gap) - (np.arange(len(commands)) - np.repeat(first, counts) + 1)
    position = end + np.sign(gap) * left
    return np.asarray(np.where(left > 0, position * np.where(position > 0, above, below), commands))


def limited(inputs: FloatArray, limit: FloatArray, dt: float, start: FloatArray) -> FloatArray:
    """Return the inputs (K, m) that a base with limits (m, 4) carries out, each the mean over its sample of `dt` [s].

    The base has reached `start` (m,) before sample 0.
    """
    taken = np.clip(inputs, -limit[:, 1], limit[:, 0])
    for j, rates in enumerate(np.minimum(limit[:, 2:], _AT_ONCE)):
        if rates.min() < _AT_ONCE:
            finer = ramps(np.repeat(taken[:, j], PARTS), rates * dt / PARTS, float(start[j]))
            taken[:, j] = finer.reshape(-1, PARTS).mean(axis=1)
    return np.asarray(taken)


class TwistRange(StrictModel):
    """Largest twist that the base carries out, on each side; a channel left out has no limit."""

    v: BaseVelocityLimit | None = Field(default=None, description="largest |v|; a number, or {forward, reverse} [m/s]")
    omega: BaseYawRateLimit | None = Field(
        default=None, description="largest |omega|; a number, or {left, right} [rad/s]"
    )

    def apply(self, twist: ArrayLike) -> FloatArray:
        """Return a twist (..., 2) cut to the range."""
        upper, lower = np.transpose([sides_of(np.inf if limit is None else limit) for limit in (self.v, self.omega)])
        return np.asarray(np.clip(np.asarray(twist, dtype=float), -lower, upper))


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
        """Return rim speeds (..., 2) left, right [m/s] of twists (..., 2) v [m/s], omega [rad/s]."""
        v, omega = np.moveaxis(np.asarray(twist, dtype=float), -1, 0)
        half = 0.5 * self.track * omega
        return np.stack([v - half, v + half], axis=-1)

    def twist(self, sides: ArrayLike) -> FloatArray:
        """Return the twists (..., 2) of rim speeds (..., 2): the exact inverse of `sides`."""
        left, right = np.moveaxis(np.asarray(sides, dtype=float), -1, 0)
        return np.stack([0.5 * (left + right), (right - left) / self.track], axis=-1)

    def apply(self, twist: ArrayLike) -> FloatArray:
        """Return the twists (..., 2) commanded to the motors, in the units of the command."""
        held = self._held(self.sides(twist))
        along = np.clip(held[..., ::-1], -self.coasting_speed, self.coasting_speed)
        return self.twist(np.where(self.coasts(twist), along, held))

    def coasts(self, twist: ArrayLike) -> NDArray[np.bool_]:
        """Return True for each side (..., 2) whose command is below one step while the opposite side is driven."""
        held = self._held(self.sides(twist))
        return np.asarray((held == 0.0) & (held[..., ::-1] != 0.0), dtype=np.bool_)

    def slope(self, twist: ArrayLike) -> FloatArray:
        """Return the (..., 2, 2) derivative of `apply`, without its steps, for a linearisation at `twist`."""
        speeds = self.sides(twist)
        free = np.ones(speeds.shape) if self.top_speed is None else (np.abs(speeds) < self.top_speed).astype(float)
        coasts = self.coasts(twist)
        along = coasts * free[..., ::-1] * (np.abs(self._held(speeds)[..., ::-1]) < self.coasting_speed)
        by_side = np.zeros((*speeds.shape, 2))
        for side, opposite in ((0, 1), (1, 0)):
            by_side[..., side, side] = np.where(coasts[..., side], 0.0, free[..., side])
            by_side[..., side, opposite] = along[..., side]
        half = 0.5 * self.track
        into, out = np.array([[1.0, -half], [1.0, half]]), np.array([[0.5, 0.5], [-1 / self.track, 1 / self.track]])
        return np.asarray(out @ by_side @ into)

    def _cut(self, sides: FloatArray) -> FloatArray:
        return sides if self.top_speed is None else np.clip(sides, -self.top_speed, self.top_speed)

    def _held(self, sides: FloatArray) -> FloatArray:
        """Cut rim speeds to top speed and, towards zero, to whole steps."""
        cut = self._cut(sides)
        if self.resolution == 0.0:
            return cut
        return np.sign(cut) * np.floor(np.abs(cut) / self.resolution + _ON_STEP) * self.resolution


class YawRelaxation(StrictModel):
    """First-order relaxation over the angle through which the wheels turn, not over time.

    With the wheels' yaw rate omega (as it is once settled) and the strain z of the tyres, -1 to 1:

        z' = (omega - |omega| z) / angle,     yaw rate of the body = |omega| z = omega - angle z'.

    So the body's heading is that of the wheels less `angle` times z, and each reversal costs twice `angle`. It is
    Dahl's friction model ("A solid friction model", 1968) between the wheels' heading and the body's.
    """

    angle: float = Field(gt=0, description="turn of the wheels over which the tyres twist [rad of yaw]")

    def advance(self, strain: float, yaw_rate: float, dt: float) -> tuple[float, float]:
        """Integrate one sample exactly under a constant yaw rate of the wheels.

        Parameters
        ----------
        strain
            z at the start, -1 to 1.
        yaw_rate
            Yaw rate of the wheels [rad/s].
        dt
            Sample time [s].

        Returns
        -------
        tuple
            z at the end, and the mean yaw rate of the body over the sample [rad/s].
        """
        side = float(np.sign(yaw_rate))
        end = side + (strain - side) * float(np.exp(-abs(yaw_rate) * dt / self.angle))
        return end, yaw_rate - self.angle * (end - strain) / dt

    def gain(self, strain: float, yaw_rate: float) -> float:
        """Return the ratio of the body's yaw rate to the wheels': 1 once settled, negative just after a reversal."""
        return strain * float(np.sign(yaw_rate))

    def follow(self, yaw_rates: ArrayLike, dt: float, strain: float) -> FloatArray:
        """Return the body's yaw rates (K,) [rad/s] for the wheels' (K,), linear between samples of `dt` [s].

        `strain` is z at the first sample; 0 for tyres without twist, the sign of the yaw rate for a settled turn.
        """
        rates = np.asarray(yaw_rates, dtype=float)
        if not len(rates):
            return rates
        mean = 0.5 * (rates[1:] + rates[:-1])
        turned = np.concatenate([[0.0], np.cumsum(np.abs(mean))]) * dt / self.angle
        moving = np.flatnonzero(mean)
        side = np.sign(mean[moving])
        # Between two reversals the strain decays towards its side with the angle turned.
        first = moving[np.flatnonzero(np.concatenate([[True], side[1:] != side[:-1]]))] if len(moving) else moving
        edges = np.concatenate([[0], first, [len(mean)]])
        sides = np.concatenate([[0.0], np.sign(mean[first])])
        initial = np.empty(len(sides))
        for run, (low, high) in enumerate(pairwise(edges)):
            initial[run] = strain
            strain = sides[run] + (strain - sides[run]) * float(np.exp(turned[low] - turned[high]))
        counts = np.diff(edges)
        towards, since = np.repeat(sides, counts), np.repeat(turned[edges[:-1]], counts)
        after = towards + (np.repeat(initial, counts) - towards) * np.exp(since - turned[1:])
        return np.asarray(np.abs(rates) * np.concatenate([initial[:1], after]))


class Veer(StrictModel):
    """Yaw rate in proportion to forward speed: omega = omega_wheels + yaw_per_metre v, wheels of unequal radius.

    Source: coefficient a31 of Ordonez et al., 2017 (their omega = w_c + a31 v_c + ...).
    """

    yaw_per_metre: float = Field(description="yaw for each metre driven forward, left positive [rad/m]")

    def body(self, wheels: ArrayLike) -> FloatArray:
        """Return the twists (..., 2) of the body for twists (..., 2) of the wheels."""
        v, omega = np.moveaxis(np.asarray(wheels, dtype=float), -1, 0)
        return np.stack([v, omega + self.yaw_per_metre * v], axis=-1)

    def wheels(self, body: ArrayLike) -> FloatArray:
        """Return the twists (..., 2) of the wheels for twists (..., 2) of the body: the exact inverse of `body`."""
        v, omega = np.moveaxis(np.asarray(body, dtype=float), -1, 0)
        return np.stack([v, omega - self.yaw_per_metre * v], axis=-1)


class PoseMount(StrictModel):
    """Lever arm and heading of a pose sensor on the robot, in the sensor's own axes.

    A velocity model describes the centre of rotation. Poses of another point, taken for it, look like side-slip.
    """

    ahead: float = Field(default=0.0, description="sensor ahead of the centre of rotation [m]")
    left: float = Field(default=0.0, description="sensor left of the centre of rotation [m]")
    heading: float = Field(
        default=0.0, ge=-np.pi, le=np.pi, description="direction of travel less sensor's heading [rad]"
    )

    def centre(self, sensor: ArrayLike) -> FloatArray:
        """Return poses (..., 3) of the centre of rotation for poses (..., 3) of the sensor: x, y [m], theta [rad]."""
        pose = np.asarray(sensor, dtype=float)
        theta = pose[..., 2]
        return self._moved(pose, theta, -1.0, theta + self.heading)

    def sensor(self, centre: ArrayLike) -> FloatArray:
        """Return poses (..., 3) of the sensor for poses (..., 3) of the centre: the exact inverse of `centre`."""
        pose = np.asarray(centre, dtype=float)
        theta = pose[..., 2] - self.heading
        return self._moved(pose, theta, 1.0, theta)

    def _moved(self, pose: FloatArray, axes: FloatArray, sign: float, theta: FloatArray) -> FloatArray:
        """Shift `pose` by the lever arm along the sensor's `axes` [rad]; set its heading to `theta`."""
        dx = np.cos(axes) * self.ahead - np.sin(axes) * self.left
        dy = np.sin(axes) * self.ahead + np.cos(axes) * self.left
        return np.stack([pose[..., 0] + sign * dx, pose[..., 1] + sign * dy, theta], axis=-1)


class BaseEffects(StrictModel):
    """Effects of the base around the linear model of the same file; a missing effect is not modelled."""

    twist_range: TwistRange | None = Field(default=None, description="speed limits inside the base")
    twist_slew: TwistSlew | None = Field(default=None, description="acceleration limits inside the base")
    wheel_command: WheelCommand | None = Field(default=None, description="steps, coasting and top speed of the motors")
    yaw_relaxation: YawRelaxation | None = Field(default=None, description="twist of the tyres at changes of direction")
    veer: Veer | None = Field(default=None, description="yaw of the body while the wheels drive straight")
    pose_mount: PoseMount | None = Field(default=None, description="where the pose sensor sits")


class Response(NamedTuple):
    """Twists at the samples of the commands."""

    wheels: FloatArray
    """(K, 2) v [m/s], omega [rad/s] that encoders with the effective track see."""
    body: FloatArray
    """(K, 2) v [m/s], omega [rad/s] of the body, which gyro and poses see."""


def respond(
    model: VelocityModel, effects: BaseEffects, commands: ArrayLike, dt: float, start: ArrayLike = (0.0, 0.0)
) -> Response:
    """Simulate from commands alone: slew, wheel commands, linear dynamics, twist of the tyres, veer.

    Parameters
    ----------
    model
        The linear dynamics, from what the motors are asked for to the settled twist of the body.
    effects
        What the base does around them.
    commands
        (K, 2) v_ref [m/s], omega_ref [rad/s], each held from its sample to the next.
    dt
        Sample time [s].
    start
        (2,) the command under which the robot is settled at sample 0.

    Raises
    ------
    ValueError
        If the commands are not K rows of two finite numbers.
    models.velocity_model.ModelError
        If `dt` is not positive and finite.
    """
    commands = np.asarray(commands, dtype=float)
    if commands.ndim != 2 or commands.shape[1] != 2 or not np.isfinite(commands).all():
        raise ValueError(f"commands of shape {commands.shape}: expected K rows of finite v_ref, omega_ref")
    start = np.asarray(start, dtype=float)
    sampled = model.discretise(dt / PARTS)
    requested = np.repeat(commands, PARTS, axis=0)
    if effects.twist_range is not None:
        requested, start = effects.twist_range.apply(requested), effects.twist_range.apply(start)
    if effects.twist_slew is not None:
        requested = effects.twist_slew.follow(requested, dt / PARTS, start)
    if effects.wheel_command is not None:
        requested, start = effects.wheel_command.apply(requested), effects.wheel_command.apply(start)
    past = np.tile(start, (sampled.memory, 1))
    wheels = sampled.simulate(requested, sampled.settled_state(start), past)
    body = wheels.copy()
    if effects.yaw_relaxation is not None and len(body):
        body[:, 1] = effects.yaw_relaxation.follow(wheels[:, 1], dt / PARTS, float(np.sign(wheels[0, 1])))
    if effects.veer is not None:
        body = effects.veer.body(body)
    return Response(wheels[::PARTS], body[::PARTS])
