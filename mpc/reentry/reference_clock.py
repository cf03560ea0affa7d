"""The reference's clock: it may wait for the robot, and catches up with the controller's clock afterwards.

The reference's time is the controller's time since the start, less a delay. The progress rate, reference time per
controller time, is piecewise linear: the plan sees exactly the future that the clock will realise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample


@dataclass(frozen=True)
class RateProfile:
    """A progress rate over the time ahead, constant after its last node.

    Attributes
    ----------
    times, rates
        (m,) nodes: time from now [s], increasing from 0, and progress rate there [-].
    settles
        Whether the delay is zero once the last node has passed.
    """

    times: tuple[float, ...]
    rates: tuple[float, ...]
    settles: bool

    def rate(self, ahead: ArrayLike) -> FloatArray:
        """Compute the progress rate at times `ahead` (n,) from now [s]."""
        return np.asarray(np.interp(np.asarray(ahead, dtype=float), self.times, self.rates))

    def progress(self, ahead: ArrayLike) -> FloatArray:
        """Compute the reference time that passes until `ahead` (n,) from now [s]: the integral of the rate."""
        ahead = np.asarray(ahead, dtype=float)
        times, rates = np.array(self.times), np.array(self.rates)
        at_nodes = np.concatenate([[0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(times))])
        node = np.maximum(np.searchsorted(times, ahead, side="right") - 1, 0)
        return np.asarray(at_nodes[node] + 0.5 * (rates[node] + self.rate(ahead)) * (ahead - times[node]))


_ON_TIME = RateProfile((0.0,), (1.0,), settles=True)


def _held(rate: float) -> RateProfile:
    return RateProfile((0.0,), (rate,), settles=False)


def settling_profile(rate: float, delay: float, slowest: float, fastest: float, ramp: float) -> RateProfile:
    """Plan the fastest return to zero delay at rate 1: a trapezoid in the excess of the rate over 1.

    The excess e relates to the delay as a speed to a distance, so this is the time-optimal motion of a double
    integrator over the distance `delay` with end speed zero, |de/dt| <= `ramp` and e inside the bounds.

    Parameters
    ----------
    rate
        Progress rate now [-].
    delay
        Controller's time less reference's time [s].
    slowest, fastest
        Rates at which an early or late reference settles [-], slowest < 1 < fastest.
    ramp
        Rate of change of the progress rate [1/s].
    """
    excess = rate - 1.0
    side = math.copysign(1.0, delay - excess * abs(excess) / (2.0 * ramp))
    peak = side * math.sqrt(max(0.0, side * ramp * delay + 0.5 * excess * excess))
    bound = fastest - 1.0 if side > 0 else 1.0 - slowest
    peak = max(-bound, min(bound, peak))
    rise, fall = abs(peak - excess) / ramp, abs(peak) / ramp
    rest = delay - 0.5 * (excess + peak) * rise - 0.5 * peak * fall
    cruise = max(0.0, rest / peak) if peak else 0.0
    nodes = ((0.0, excess), (rise, peak), (rise + cruise, peak), (rise + cruise + fall, 0.0))
    return RateProfile(tuple(t for t, _ in nodes), tuple(1.0 + e for _, e in nodes), settles=True)


class ReferenceClock:
    """Counts the reference's time.

    Parameters
    ----------
    max_progress
        Fastest progress rate while catching up, > 1; early by mistake, the reference goes at 2 less this [-].
    ramp
        Rate of change of the progress rate, other than slowing down at once for a robot that lags [1/s].
    """

    def __init__(self, max_progress: float, ramp: float) -> None:
        self._fastest, self._ramp = max_progress, ramp
        self.restart()

    def restart(self) -> None:
        """Run on time, from the next `advance` on."""
        self.delay = 0.0
        self.rate = 1.0
        self._last: float | None = None
        self._profile = _ON_TIME

    @property
    def on_time(self) -> bool:
        """True if the reference's time equals the controller's, now and over the plan."""
        return self.delay == 0.0 and self._profile is _ON_TIME

    def advance(self, since_start: float, *, driving: bool) -> float:
        """Advance to the controller's time `since_start` [s]; the reference stands still unless `driving`.

        Returns
        -------
        float
            The reference's time [s].
        """
        # Before its start the reference rests: nothing to wait for.
        before, now = max(0.0, since_start if self._last is None else self._last), max(0.0, since_start)
        self._last = since_start
        passed = max(0.0, now - before)
        if not driving:
            self.delay += passed
        elif not self.on_time:
            if self._profile.settles and passed >= self._profile.times[-1]:
                self.delay = 0.0
            else:
                self.delay += passed - float(self._profile.progress(passed))
            self.rate = float(self._profile.rate(passed))
        return since_start - self.delay

    def pass_by(self, since_start: float) -> None:
        """Advance to the controller's time `since_start` [s], on time as before."""
        self._last = since_start

    def set(self, delay: float, rate: float) -> None:
        """Continue with this delay [s] and progress rate [-]."""
        self.delay, self.rate = delay, rate

    def run_on(self) -> None:
        """Keep the present delay from now on."""
        self.rate, self._profile = 1.0, _held(1.0)

    def plan(self, most: float, *, catch_up: bool) -> None:
        """Decide the progress rate from now on.

        Parameters
        ----------
        most
            Largest rate that the robot's lag allows now [-].
        catch_up
            Whether to work off the delay; if not, the rate returns to 1 and the delay stays.
        """
        ramp = self._ramp
        if self.delay == 0.0 and self.rate == 1.0 and most >= 1.0:
            self._profile = _ON_TIME
        elif catch_up and most > 1.0:
            self._profile = settling_profile(self.rate, self.delay, 2.0 - self._fastest, min(self._fastest, most), ramp)
        else:
            # A robot that lags is waited for at once; after that the rate comes back gently.
            wanted = min(most, 1.0)
            self.rate = min(self.rate, most)
            rise = abs(wanted - self.rate) / ramp
            self._profile = RateProfile((0.0, rise), (self.rate, wanted), settles=False) if rise else _held(wanted)

    def clocked(self, reference: Reference) -> Reference:
        """Return `reference` on the controller's time, as the clock will pass through it."""
        return ClockedReference(reference, self._profile, (self._last or 0.0), self.delay)


@dataclass(frozen=True)
class ClockedReference:
    """A reference on the controller's time; satisfies `models.interface.Reference` from `now` on.

    Attributes
    ----------
    reference
        The reference on its own time.
    profile
        Its progress rate from now on.
    now, delay
        The controller's time now, and that less the reference's [s].
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
        """Controller's time at which the reference ends if it keeps its present delay [s]."""
        return self.reference.duration + self.delay

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at the controller's times `times` (n,) [s], not before `now`; twists scale with the rate."""
        ahead = np.asarray(times, dtype=float) - self.now
        sample = self.reference.sample(self.now - self.delay + self.profile.progress(ahead))
        return ReferenceSample(sample.pose, sample.twist * self.profile.rate(ahead)[:, None], sample.arc_length)
