"""Effects of a real base in addition to its linear dynamics: limits of the command, and slip of the body.

`TwistRange`, `TwistSlew` and `WheelCommand` precede the velocity model; `YawRelaxation` and `Veer` follow it.
`PoseMount` is the position of the pose sensor. Each effect is optional; `BaseEffects` is their group in a model file,
and `respond` applies them in this order.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.two_sided import BaseSlewLimit, BaseVelocityLimit, BaseYawRateLimit, limit_step, sides_of
from diffdrive_mpc.models.velocity_model import VelocityModel

# Rate above the rates of all robots, used instead of infinity [m/s^2 or rad/s^2].
_UNLIMITED_RATE = 1e6
# Tolerance for speeds at a step with rounded decimals [steps].
_ROUNDING = 1e-9
KINDS = ("upper", "lower", "accelerate", "brake")
"""Kinds of limits: maximum command above and below zero [units of the input], maximum rates at which its magnitude
increases and decreases [units of the input per second].
"""
PARTS = 4
"""Number of parts of a sample for ramps inside the base; the limited command is constant in each part."""


class TwistSlew(StrictModel):
    """Separate slew limits of each channel of the commanded twist inside the base; None means no limit.

    If the slew limits of the controller are not wider, these limits are inactive and its linear model is valid.
    """

    v: BaseSlewLimit | None = Field(
        default=None,
        description="maximum slope of v_ref that the base follows; a number, or {accelerate, brake} [m/s^2]",
    )
    omega: BaseSlewLimit | None = Field(
        default=None,
        description="maximum slope of omega_ref that the base follows; a number, or {accelerate, brake} [rad/s^2]",
    )

    @property
    def _rates(self) -> FloatArray:
        """(2, 2) maximum rates of increase and decrease of |v| and |omega|; finite, so that ramps have a duration."""
        limits = (sides_of(np.inf if limit is None else limit) for limit in (self.v, self.omega))
        return np.minimum(list(limits), _UNLIMITED_RATE)

    def step(self, previous: ArrayLike, command: ArrayLike, dt: float) -> FloatArray:
        """Return the twist (..., 2) that the base reaches `dt` [s] after `previous` on the ramp to `command`."""
        return limit_step(np.asarray(previous, dtype=float), np.asarray(command, dtype=float), *self._rates.T * dt)

    def follow(self, commands: ArrayLike, dt: float, start: ArrayLike) -> FloatArray:
        """Return twists (K, 2) inside the base after samples of `dt` [s] under `commands` (K, 2), from `start` (2,)."""
        columns = zip(np.asarray(commands, dtype=float).T, self._rates, np.asarray(start, dtype=float), strict=True)
        return np.stack([ramps(column, rates * dt, float(first)) for column, rates, first in columns], axis=-1)


def ramps(commands: FloatArray, rates: FloatArray, start: float) -> FloatArray:
    """Return commands (K,) with limited changes from `start`.

    The magnitude increases by at most `rates[0]` and decreases by at most `rates[1]` per sample. Each run of equal
    commands has one ramp; a position on it is the number of samples from zero.
    """
    if not len(commands):
        return np.empty(0)
    first = np.flatnonzero(np.concatenate([[True], np.diff(commands) != 0]))
    counts = np.diff(np.append(first, len(commands)))
    # The rate changes if a ramp crosses zero. With the position as number of samples from zero, all ramps have slope 1.
    increase, decrease = rates.tolist()
    starts, last, slowest = [], start, min(increase, decrease)
    # Python floats are faster here, because the command of a log may change at every sample.
    for target, count in zip(commands[first].tolist(), counts.tolist(), strict=True):
        starts.append(last)
        change = target - last
        # In most cases the target is reached within the run even at the slower rate.
        if -slowest * count <= change <= slowest * count:
            last = target
            continue
        above, below = (increase, decrease) if change > 0 else (decrease, increase)
        end = target / (above if target > 0 else below)
        gap = last / (above if last > 0 else below) - end
        remaining = abs(gap) - count
        position = end + (remaining if gap > 0 else -remaining)
        last = position * (above if position > 0 else below) if remaining > 0 else target
    # With the known start of each ramp, apply the same formula to all samples at once.
    before = np.repeat(starts, counts)
    above, below = np.where(commands > before, [[increase], [decrease]], [[decrease], [increase]])
    end = commands / np.where(commands > 0, above, below)
    gap = before / np.where(before > 0, above, below) - end
    remaining = np.abs(gap) - (np.arange(len(commands)) - np.repeat(first, counts) + 1)
    position = end + np.sign(gap) * remaining
    return np.asarray(np.where(remaining > 0, position * np.where(position > 0, above, below), commands))


def apply_limits(inputs: FloatArray, limit: FloatArray, dt: float, start: FloatArray) -> FloatArray:
    """Apply the limits (m, 4) of a base to inputs (K, m); return means over samples of `dt` [s].

    The limited input before sample 0 is `start` (m,).
    """
    values = np.clip(inputs, -limit[:, 1], limit[:, 0])
    for j, rates in enumerate(np.minimum(limit[:, 2:], _UNLIMITED_RATE)):
        if rates.min() < _UNLIMITED_RATE:
            # The mean over the parts of a sample approximates the ramp within the sample.
            part_values = ramps(np.repeat(values[:, j], PARTS), rates * dt / PARTS, float(start[j]))
            values[:, j] = part_values.reshape(-1, PARTS).mean(axis=1)
    return np.asarray(values)


class TwistRange(StrictModel):
    """Maximum twist of the base on each side; None means no limit."""

    v: BaseVelocityLimit | None = Field(default=None, description="maximum |v|; a number, or {forward, reverse} [m/s]")
    omega: BaseYawRateLimit | None = Field(
        default=None, description="maximum |omega|; a number, or {left, right} [rad/s]"
    )

    def apply(self, twist: ArrayLike) -> FloatArray:
        """Clip a twist (..., 2) to the range."""
        upper, lower = np.transpose([sides_of(np.inf if limit is None else limit) for limit in (self.v, self.omega)])
        return np.asarray(np.clip(np.asarray(twist, dtype=float), -lower, upper))


class WheelCommand(StrictModel):
    """Static map of a base from (v, omega) to the rim speed of each side.

    Rim speeds are clipped to `top_speed` and truncated to whole steps of `resolution`. A side with a command below one
    step is not controlled: it follows the other side up to `coasting_speed`. This was observed on a Husky A200: if the
    command of one side was below 0.01 m/s, its wheels followed the wheels of the other side up to 0.5 rad/s.
    """

    track: float = Field(gt=0, description="track by which the base converts omega_ref to rim speeds [m]")
    resolution: float = Field(default=0.0, ge=0, description="step to which rim speeds are truncated [m/s]")
    coasting_speed: float = Field(
        default=0.0, ge=0, description="maximum rim speed of an uncontrolled side that coasts [m/s]"
    )
    top_speed: float | None = Field(default=None, gt=0, description="maximum rim speed of the motors [m/s]")

    @model_validator(mode="after")
    def _check_top_speed(self) -> WheelCommand:
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
        """Return the twists (..., 2) of rim speeds (..., 2), the exact inverse of `sides`."""
        left, right = np.moveaxis(np.asarray(sides, dtype=float), -1, 0)
        return np.stack([0.5 * (left + right), (right - left) / self.track], axis=-1)

    def apply(self, twist: ArrayLike) -> FloatArray:
        """Return the twists (..., 2) commanded to the motors, in the units of the command."""
        speeds = self._quantise(self.sides(twist))
        coasting = np.clip(speeds[..., ::-1], -self.coasting_speed, self.coasting_speed)
        return self.twist(np.where(self.coasts(twist), coasting, speeds))

    def coasts(self, twist: ArrayLike) -> NDArray[np.bool_]:
        """Return True for each side (..., 2) whose command is below one step while the opposite side is driven."""
        speeds = self._quantise(self.sides(twist))
        return np.asarray((speeds == 0.0) & (speeds[..., ::-1] != 0.0), dtype=np.bool_)

    def slope(self, twist: ArrayLike) -> FloatArray:
        """Return the derivative (..., 2, 2) of `apply` at `twist`, without the steps of the resolution."""
        speeds = self.sides(twist)
        free = np.ones(speeds.shape) if self.top_speed is None else (np.abs(speeds) < self.top_speed).astype(float)
        coasts = self.coasts(twist)
        follows = coasts * free[..., ::-1] * (np.abs(self._quantise(speeds)[..., ::-1]) < self.coasting_speed)
        by_side = np.zeros((*speeds.shape, 2))
        for side, opposite in ((0, 1), (1, 0)):
            by_side[..., side, side] = np.where(coasts[..., side], 0.0, free[..., side])
            by_side[..., side, opposite] = follows[..., side]
        half = 0.5 * self.track
        into, out = np.array([[1.0, -half], [1.0, half]]), np.array([[0.5, 0.5], [-1 / self.track, 1 / self.track]])
        return np.asarray(out @ by_side @ into)

    def _quantise(self, sides: FloatArray) -> FloatArray:
        """Clip rim speeds to the top speed and truncate them to whole steps."""
        clipped = sides if self.top_speed is None else np.clip(sides, -self.top_speed, self.top_speed)
        if self.resolution == 0.0:
            return clipped
        return np.sign(clipped) * np.floor(np.abs(clipped) / self.resolution + _ROUNDING) * self.resolution


class YawRelaxation(StrictModel):
    """First-order relaxation over the turn angle of the wheels instead of time.

    omega is the yaw rate of the wheels, which is the steady-state yaw rate of the body; z is the strain of the tyres
    from -1 to 1:

        z' = (omega - |omega| z) / angle,     yaw rate of the body = |omega| z = omega - angle z'.

    The heading of the body is therefore the heading of the wheels minus `angle` times z, and each reversal causes an
    offset of twice `angle`. This is Dahl's friction model ("A solid friction model", 1968) between the headings of
    wheels and body.
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
        """Return the ratio of the yaw rates of body and wheels: 1 in steady state, negative after a reversal."""
        return strain * float(np.sign(yaw_rate))

    def follow(self, yaw_rates: ArrayLike, dt: float, strain: float) -> FloatArray:
        """Return the yaw rates (K,) of the body [rad/s] for yaw rates (K,) of the wheels at samples of `dt` [s].

        The yaw rate of the wheels is linear between samples.

        `strain` is z at the first sample: 0 for relaxed tyres, the sign of the yaw rate for a steady turn.
        """
        rates = np.asarray(yaw_rates, dtype=float)
        if not len(rates):
            return rates
        mean = 0.5 * (rates[1:] + rates[:-1])
        turn_angle = np.concatenate([[0.0], np.cumsum(np.abs(mean))]) * dt / self.angle
        moving = np.flatnonzero(mean)
        side = np.sign(mean[moving])
        # Between two reversals, the strain approaches the sign of the turn exponentially over the turn angle.
        first = moving[np.flatnonzero(np.concatenate([[True], side[1:] != side[:-1]]))] if len(moving) else moving
        edges = np.concatenate([[0], first, [len(mean)]])
        sides = np.concatenate([[0.0], np.sign(mean[first])])
        initial = np.empty(len(sides))
        for run, (low, high) in enumerate(pairwise(edges)):
            initial[run] = strain
            strain = sides[run] + (strain - sides[run]) * float(np.exp(turn_angle[low] - turn_angle[high]))
        counts = np.diff(edges)
        towards, since = np.repeat(sides, counts), np.repeat(turn_angle[edges[:-1]], counts)
        after = towards + (np.repeat(initial, counts) - towards) * np.exp(since - turn_angle[1:])
        return np.asarray(np.abs(rates) * np.concatenate([initial[:1], after]))


class Veer(StrictModel):
    """Yaw rate proportional to the forward speed, due to unequal wheel radii: omega = omega_wheels + yaw_per_metre v.

    Source: coefficient a31 of Ordonez et al., 2017 (their omega = w_c + a31 v_c + ...).
    """

    yaw_per_metre: float = Field(description="yaw per metre of forward motion, left is positive [rad/m]")

    def body(self, wheels: ArrayLike) -> FloatArray:
        """Return the twists (..., 2) of the body for twists (..., 2) of the wheels."""
        v, omega = np.moveaxis(np.asarray(wheels, dtype=float), -1, 0)
        return np.stack([v, omega + self.yaw_per_metre * v], axis=-1)

    def wheels(self, body: ArrayLike) -> FloatArray:
        """Return the twists (..., 2) of the wheels for twists (..., 2) of the body, the exact inverse of `body`."""
        v, omega = np.moveaxis(np.asarray(body, dtype=float), -1, 0)
        return np.stack([v, omega - self.yaw_per_metre * v], axis=-1)


class PoseMount(StrictModel):
    """Lever arm and heading of a pose sensor on the robot, in the axes of the sensor.

    A velocity model describes the centre of rotation. Without correction, poses of another point appear as side-slip.
    """

    ahead: float = Field(default=0.0, description="distance of the sensor ahead of the centre of rotation [m]")
    left: float = Field(default=0.0, description="distance of the sensor to the left of the centre of rotation [m]")
    heading: float = Field(
        default=0.0, ge=-np.pi, le=np.pi, description="direction of travel minus heading of the sensor [rad]"
    )

    def centre(self, sensor: ArrayLike) -> FloatArray:
        """Return poses (..., 3) of the centre of rotation for poses (..., 3) of the sensor: x, y [m], theta [rad]."""
        pose = np.asarray(sensor, dtype=float)
        theta = pose[..., 2]
        return self._shift_pose(pose, theta, -1.0, theta + self.heading)

    def sensor(self, centre: ArrayLike) -> FloatArray:
        """Return poses (..., 3) of the sensor for poses (..., 3) of the centre, the exact inverse of `centre`."""
        pose = np.asarray(centre, dtype=float)
        theta = pose[..., 2] - self.heading
        return self._shift_pose(pose, theta, 1.0, theta)

    def _shift_pose(self, pose: FloatArray, axes: FloatArray, sign: float, theta: FloatArray) -> FloatArray:
        """Shift `pose` by the lever arm along the sensor's `axes` [rad]; set its heading to `theta`."""
        dx = np.cos(axes) * self.ahead - np.sin(axes) * self.left
        dy = np.sin(axes) * self.ahead + np.cos(axes) * self.left
        return np.stack([pose[..., 0] + sign * dx, pose[..., 1] + sign * dy, theta], axis=-1)


class BaseEffects(StrictModel):
    """Effects of the base in addition to the linear model of the same file; None if an effect is not modelled."""

    twist_range: TwistRange | None = Field(default=None, description="speed limits inside the base")
    twist_slew: TwistSlew | None = Field(default=None, description="acceleration limits inside the base")
    wheel_command: WheelCommand | None = Field(default=None, description="steps, coasting and top speed of the motors")
    yaw_relaxation: YawRelaxation | None = Field(default=None, description="tyre twist at changes of direction")
    veer: Veer | None = Field(default=None, description="yaw of the body while the wheels drive straight")
    pose_mount: PoseMount | None = Field(default=None, description="position and heading of the pose sensor")


class Response(NamedTuple):
    """Twists at the samples of the commands."""

    wheels: FloatArray
    """(K, 2) v [m/s], omega [rad/s] as measured by encoders with the effective track."""
    body: FloatArray
    """(K, 2) v [m/s], omega [rad/s] of the body, as measured by gyro and poses."""


def respond(
    model: VelocityModel, effects: BaseEffects, commands: ArrayLike, dt: float, start: ArrayLike = (0.0, 0.0)
) -> Response:
    """Simulate slew, wheel commands, linear dynamics, tyre twist and veer from commands only.

    Parameters
    ----------
    model
        Linear dynamics from the command of the motors to the steady-state twist of the body.
    effects
        Effects of the base.
    commands
        (K, 2) v_ref [m/s], omega_ref [rad/s], held between samples.
    dt
        Sample time [s].
    start
        (2,) command in whose steady state the simulation starts.

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
    # Simulate parts of a sample, because a ramp changes the command within a sample.
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
