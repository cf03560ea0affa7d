"""Clock of the reference, which may wait for the robot and afterwards catch up with the controller's clock.

The reference's time is the controller's time since the start minus a delay. The progress rate is the derivative of the
reference's time by the controller's time. Its plan over the horizon is piecewise linear, and the clock follows the plan
exactly until the next tick.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample


@dataclass(frozen=True)
class RateProfile:
    """Progress rate over the time ahead; constant after the last node.

    Attributes
    ----------
    times, rates
        (m,) times of the nodes since the current tick [s], increasing from 0, and progress rates at the nodes [-].
    settles
        True if the delay is zero after the last node.
    """

    times: tuple[float, ...]
    rates: tuple[float, ...]
    settles: bool

    def rate(self, ahead: ArrayLike) -> FloatArray:
        """Compute the progress rate (n,) at times `ahead` (n,) after the current tick [s]."""
        return np.asarray(np.interp(np.asarray(ahead, dtype=float), self.times, self.rates))

    def progress(self, ahead: ArrayLike) -> FloatArray:
        """Compute the reference time (n,) [s] that elapses until `ahead` (n,) [s]: the integral of the rate."""
        ahead = np.asarray(ahead, dtype=float)
        times, rates = np.array(self.times), np.array(self.rates)
        at_nodes = np.concatenate([[0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(times))])
        node = np.maximum(np.searchsorted(times, ahead, side="right") - 1, 0)
        return np.asarray(at_nodes[node] + 0.5 * (rates[node] + self.rate(ahead)) * (ahead - times[node]))


_ON_TIME = RateProfile((0.0,), (1.0,), settles=True)


def _constant_profile(rate: float) -> RateProfile:
    return RateProfile((0.0,), (rate,), settles=False)


def settling_profile(rate: float, delay: float, min_rate: float, max_rate: float, ramp: float) -> RateProfile:
    """Plan the fastest return to zero delay at rate 1: a trapezoid of the excess of the rate over 1.

    The excess e is the rate at which the delay decreases. The profile is therefore the time-optimal motion of a double
    integrator over the distance `delay`, with end speed zero, |de/dt| <= `ramp`, and e within its bounds.

    Parameters
    ----------
    rate
        Current progress rate [-].
    delay
        Controller's time minus reference's time [s].
    min_rate, max_rate
        Minimum rate of an early and maximum rate of a late reference [-], min_rate < 1 < max_rate.
    ramp
        Rate of change of the progress rate [1/s].
    """
    excess = rate - 1.0
    # A ramp of the excess to zero reduces the delay by e|e| / (2 ramp). The sign of the remaining delay is the sign of
    # the peak.
    side = math.copysign(1.0, delay - excess * abs(excess) / (2.0 * ramp))
    # The peak of a triangle, which is the profile without bounds, follows from its area, the delay.
    peak = side * math.sqrt(max(0.0, side * ramp * delay + 0.5 * excess * excess))
    bound = max_rate - 1.0 if side > 0 else 1.0 - min_rate
    peak = max(-bound, min(bound, peak))
    rise, fall = abs(peak - excess) / ramp, abs(peak) / ramp
    remaining_delay = delay - 0.5 * (excess + peak) * rise - 0.5 * peak * fall
    cruise = max(0.0, remaining_delay / peak) if peak else 0.0
    nodes = ((0.0, excess), (rise, peak), (rise + cruise, peak), (rise + cruise + fall, 0.0))
    return RateProfile(tuple(t for t, _ in nodes), tuple(1.0 + e for _, e in nodes), settles=True)


class ReferenceClock:
    """Clock of the reference.

    Parameters
    ----------
    max_progress
        Maximum progress rate while catching up, > 1; an early reference slows down to 2 - `max_progress` [-].
    ramp
        Rate of change of the progress rate [1/s]; for a lagging robot, the rate decreases immediately.
    """

    def __init__(self, max_progress: float, ramp: float) -> None:
        self._max_progress, self._ramp = max_progress, ramp
        self.restart()

    def restart(self) -> None:
        """Reset the delay, so that the next `advance` returns the controller's time."""
        self.delay = 0.0
        self.rate = 1.0
        self._last_time: float | None = None
        self._profile = _ON_TIME

    @property
    def on_time(self) -> bool:
        """True if the delay is zero at the current tick and over the horizon."""
        return self.delay == 0.0 and self._profile is _ON_TIME

    def advance(self, since_start: float, *, driving: bool) -> float:
        """Advance to the controller's time `since_start` [s]; the reference's clock stops if `driving` is False.

        Returns
        -------
        float
            The reference's time [s].
        """
        # Negative times are before the start, when the reference cannot wait.
        before, now = max(0.0, since_start if self._last_time is None else self._last_time), max(0.0, since_start)
        self._last_time = since_start
        elapsed = max(0.0, now - before)
        if not driving:
            self.delay += elapsed
        elif not self.on_time:
            if self._profile.settles and elapsed >= self._profile.times[-1]:
                self.delay = 0.0
            else:
                self.delay += elapsed - float(self._profile.progress(elapsed))
            self.rate = float(self._profile.rate(elapsed))
        return since_start - self.delay

    def record_on_time(self, since_start: float) -> None:
        """Advance to the controller's time `since_start` [s] without a change of delay and rate."""
        self._last_time = since_start

    def set(self, delay: float, rate: float) -> None:
        """Set the delay [s] and the progress rate [-] from which the clock continues."""
        self.delay, self.rate = delay, rate

    def keep_delay(self) -> None:
        """Keep the current delay from the next `advance` on."""
        self.rate, self._profile = 1.0, _constant_profile(1.0)

    def plan(self, limit: float, *, catch_up: bool) -> None:
        """Plan the progress rate from the current tick on.

        Parameters
        ----------
        limit
            Maximum progress rate [-].
        catch_up
            True to reduce the delay to zero; False to return to rate 1 and keep the delay.
        """
        ramp = self._ramp
        if self.delay == 0.0 and self.rate == 1.0 and limit >= 1.0:
            self._profile = _ON_TIME
        elif catch_up and limit > 1.0:
            self._profile = settling_profile(
                self.rate, self.delay, 2.0 - self._max_progress, min(self._max_progress, limit), ramp
            )
        else:
            # The rate decreases immediately if the robot lags; it increases again with a limited slope.
            target = min(limit, 1.0)
            self.rate = min(self.rate, limit)
            rise = abs(target - self.rate) / ramp
            self._profile = _constant_profile(target)
            if rise:
                self._profile = RateProfile((0.0, rise), (self.rate, target), settles=False)

    def apply(self, reference: Reference) -> Reference:
        """Return `reference` as a function of the controller's time, with the planned progress rate."""
        return ClockedReference(reference, self._profile, (self._last_time or 0.0), self.delay)


@dataclass(frozen=True)
class ClockedReference:
    """Reference as a function of the controller's time, an implementation of `models.interface.Reference`.

    Attributes
    ----------
    reference
        Reference as a function of the reference's time.
    profile
        Progress rate from `now` on.
    now, delay
        Current time of the controller, and the delay of the reference's clock at that time [s].
    """

    reference: Reference
    profile: RateProfile
    now: float
    delay: float

    @property
    def name(self) -> str:
        """Name of the reference."""
        return self.reference.name

    @property
    def duration(self) -> float:
        """Controller's time at which the reference ends with the current delay [s]."""
        return self.reference.duration + self.delay

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Sample at the controller's `times` (n,) [s], not before `now`; the twists are multiplied by the rate."""
        ahead = np.asarray(times, dtype=float) - self.now
        sample = self.reference.sample(self.now - self.delay + self.profile.progress(ahead))
        return ReferenceSample(sample.pose, sample.twist * self.profile.rate(ahead)[:, None], sample.arc_length)
