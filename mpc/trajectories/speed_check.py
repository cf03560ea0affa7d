"""Checks of a reference against the limits before a drive."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.errors import wrong_type
from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.models.two_sided import TwoSided, side_of, sides_at
from diffdrive_mpc.mpc.config.fixed_values import STANDING, TURNING
from diffdrive_mpc.mpc.config.schema import Limits


class CheckedReference:
    """Wrapper of a user-defined reference that checks the shapes of its samples and converts them to float arrays.

    Parameters
    ----------
    reference
        Any object that samples poses, twists and arc lengths.
    """

    def __init__(self, reference: Reference) -> None:
        self._reference = reference

    @property
    def name(self) -> str:
        """Name in tables and figures."""
        return self._reference.name

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self._reference.duration

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Sample at `times` (n,) [s].

        Raise ArgumentError if the reference does not return a sample, and ValueError if it has other shapes.
        """
        sample, count = self._reference.sample(times), np.size(times)
        if not all(hasattr(sample, name) for name in ReferenceSample._fields):
            remedy = "return ReferenceSample(pose, twist, arc_length) of diffdrive_mpc.models.interface"
            raise wrong_type(f"reference '{self.name}': sample(times)", "a ReferenceSample", sample, remedy)
        return ReferenceSample(
            self._check_shape("pose", sample.pose, (count, 3)),
            self._check_shape("twist", sample.twist, (count, 2)),
            self._check_shape("arc_length", sample.arc_length, (count,)),
        )

    def _check_shape(self, name: str, values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
        array = np.asarray(values, dtype=float)
        if array.shape != shape:
            raise ValueError(
                f"reference '{self.name}': {name} of sample(times) has shape {array.shape} for {shape[0]} times; "
                f"expected {shape}"
            )
        return array


def checked_reference(reference: Reference) -> Reference:
    """Wrap `reference` in a `CheckedReference`, unless the compiled core can sample it."""
    return reference if getattr(reference, "native", None) is not None else CheckedReference(reference)


# Tolerated ratio of a speed to its limit [-]; a spline through timed poses may overshoot slightly.
_MAX_SPEED_RATIO = 1.01
# Tolerated ratio of the steady-state command for a twist to its limit [-]; above the limit the robot lags, and the
# reference waits.
_MAX_COMMAND_RATIO = 1.25
_MAX_SAMPLES = 100_000
_MAX_DURATION = 1e9
# Maximum position [m] and heading [rad]; rounding errors dominate the differences of larger values.
_MAX_POSE = 1e9
# Tolerances of the turn radius check for rounding and overshoot of splines [-, m/s].
_RADIUS_SHARE, _TURN_MARGIN = 0.99, 1e-3
# Tolerated turn at standstill if commands have a minimum radius [rad], for rounding at the end of a curve.
_MAX_SPOT_TURN = 0.1


def check_speeds(
    reference: Reference, limits: Limits, dt: float, gain: FloatArray | None = None, start_time: float = 0.0
) -> None:
    """Compare the speeds of `reference`, sampled every `dt` [s], with the hard limits of the command.

    If the steady-state `gain` (2, 2) of the model is given, the commands for the reference's twist are also compared.
    The check starts at the time `start_time` [s] of the reference.

    Raises
    ------
    ValueError
        If a speed exceeds its limit, the duration or a pose is not finite, or poses or twists have a wrong shape; the
        message is one line with reference, time, value and limit.
    """
    times = _sample_times(reference, dt)
    # At least two samples are kept, since the checks use their spacing.
    times = times[min(int(np.searchsorted(times, start_time)), times.size - 2) :]
    sample = checked_reference(reference).sample(times)
    # This comparison and those of the speeds below are negated, so that NaN is invalid.
    invalid = np.flatnonzero(~(np.abs(sample.pose) <= _MAX_POSE).all(axis=1))
    if invalid.size:
        raise ValueError(
            f"reference '{reference.name}': its pose at {times[invalid[0]]:.2f} s is not finite, or more than "
            f"{_MAX_POSE:g} m from the origin"
        )
    twist = sample.twist
    commands = twist if gain is None else np.asarray(np.linalg.solve(gain, twist.T).T, dtype=float)
    for row, (name, limit) in enumerate((("v", limits.v), ("omega", limits.omega))):
        worst = int(np.argmax(np.abs(twist[:, row]) / sides_at(limit, twist[:, row])))
        value, bound, side = at_side(twist[worst, row], limit)
        if not value <= bound * _MAX_SPEED_RATIO:
            raise ValueError(
                f"reference '{reference.name}': {name} = {value:.3g} at {times[worst]:.2f} s is more than "
                f"limits.{name}{side} = {bound:g}; slow the reference down or raise the limit"
            )
        worst = int(np.argmax(np.abs(commands[:, row]) / sides_at(limit, commands[:, row])))
        value, bound, side = at_side(commands[worst, row], limit)
        if not value <= bound * _MAX_COMMAND_RATIO:
            raise ValueError(
                f"reference '{reference.name}': {name} = {abs(twist[worst, row]):.3g} at {times[worst]:.2f} s takes a "
                f"command of {value:.3g} by the model's gain, more than limits.{name}{side} = {bound:g}; slow the "
                "reference down, raise the limit, or identify the model on this robot"
            )
    twist = np.abs(twist)
    _check_turns_on_the_spot(reference.name, times, twist, limits)
    radius = limits.min_turn_radius
    if radius is not None:
        excess = twist[:, 1] * radius * _RADIUS_SHARE - twist[:, 0]
        worst = int(np.argmax(excess))
        if excess[worst] > _TURN_MARGIN:
            v, omega = twist[worst]
            raise ValueError(
                f"reference '{reference.name}': at {times[worst]:.2f} s it turns with a radius of {v / omega:.3g} m, "
                f"tighter than limits.min_turn_radius = {radius:g}; give a wider path (see --scale-to-robot), or "
                "remove the limit"
            )


def at_side(value: float, limit: TwoSided) -> tuple[float, float, str]:
    """Return the absolute value, the limit of its side, and the key suffix of this side if the sides differ."""
    suffix = "" if limit.is_symmetric else f".{limit.names[bool(value < 0.0)]}"
    return abs(float(value)), side_of(limit, value), suffix


def _check_turns_on_the_spot(name: str, times: FloatArray, twist: FloatArray, limits: Limits) -> None:
    """Raise ValueError if commands have a minimum radius and the absolute `twist` (n, 2) has a turn on the spot."""
    radius = limits.min_commanded_radius
    if radius is None:
        return
    v, omega = twist.T
    # False at both ends makes the edges pairs: start and end of each turn.
    edges = np.flatnonzero(np.diff((v <= STANDING) & (omega > TURNING), prepend=False, append=False))
    for first, end in edges.reshape(-1, 2):
        angle = float(omega[first:end].sum() * (times[1] - times[0]))
        if angle > _MAX_SPOT_TURN:
            raise ValueError(
                f"reference '{name}': at {times[first]:.2f} s it turns on the spot by {angle:.2g} rad, which "
                f"limits.min_commanded_radius = {radius:g} forbids; give a path of curves, or remove the limit"
            )


def describe_tight_turns(reference: Reference, limits: Limits, dt: float, gain: FloatArray | None = None) -> str:
    """Return a message if the reference turns more tightly than the commands are allowed to; empty otherwise.

    The twist is sampled every `dt` [s]. If the steady-state `gain` (2, 2) of the model is given, the commands for the
    twist are checked instead of the twist. A reference with tight turns is valid, but the robot cuts its corners.
    """
    radius = limits.min_commanded_radius
    if radius is None:
        return ""
    times = _sample_times(reference, dt)
    twist = reference.sample(times).twist
    v, omega = np.abs(twist if gain is None else np.linalg.solve(gain, twist.T).T).T
    excess = omega * radius * _RADIUS_SHARE - v
    count = np.count_nonzero(excess > _TURN_MARGIN)
    if not count:
        return ""
    worst = int(np.argmax(excess))
    return (
        f"reference '{reference.name}': for {count * (times[1] - times[0]):.1f} s it turns tighter than "
        f"limits.min_commanded_radius = {radius:g}, down to {v[worst] / omega[worst]:.2g} m at {times[worst]:.2f} s; "
        "the robot cuts the corners"
    )


def _sample_times(reference: Reference, dt: float) -> FloatArray:
    if not 0.0 <= reference.duration <= _MAX_DURATION:
        raise ValueError(
            f"reference '{reference.name}': its duration is {reference.duration:g} s; give at most {_MAX_DURATION:g} s"
        )
    return np.linspace(0.0, reference.duration, int(min(reference.duration / dt + 2.0, _MAX_SAMPLES)))
