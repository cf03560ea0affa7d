"""Choice of the target at each tick: the reference on time, the waiting reference, or the path back to it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc.config.fixed_values import AHEAD, BEHIND, STANDING, TURNING
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.reentry.options import Course
from diffdrive_mpc.mpc.reentry.path_window import PathWindow
from diffdrive_mpc.mpc.reentry.reference_clock import ReferenceClock
from diffdrive_mpc.mpc.reentry.target import BlockedWatch, StandingReference, Target, TooFar
from diffdrive_mpc.mpc.reentry.way_back import Rejoin, Room, rejoin
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits

# Steps of the window in samples of the controller.
_WINDOW_STEP = 2.5
_MOST_SAMPLES = 5000
_NOW = np.zeros(1)
# Share of the attainable wheel speed that the reference may use, the rest being for path corrections [-]; and how far
# ahead the reference is checked for it [s].
_USABLE, _LOOK = 0.85, 0.6
# As in mpc/config/sensor_test.yaml.
_ON_SPOT = 0.5
# Share of a speed limit that the reference may use, the rest being for path corrections [-].
_KEPT = 0.95
# The band is no narrower than the deviation of the position times this.
_UNSURE = 3.0


class Stray(Protocol):
    """Deviation of the robot from a reference pose."""

    @property
    def outside(self) -> bool:
        """True if the robot is outside the band around its path, or was moved along it."""
        ...

    @property
    def late(self) -> float:
        """Delay in units of the lag from which the reference waits [-]."""
        ...


class Pursuit:
    """Follows one reference; holds its clock and the path back, if one exists.

    Parameters
    ----------
    config
        Limits, and the groups `reentry` and `failure`.
    stray
        Returns the robot's deviation from a reference pose (3,) with twist (2,).
    limited_by
        Returns the key of the limit that cost the last plan most; empty if none.
    """

    def __init__(
        self,
        config: ControllerConfig,
        stray: Callable[[FloatArray, FloatArray], Stray],
        limited_by: Callable[[], str] = str,
    ) -> None:
        self._stray_from, self._limited_by = stray, limited_by
        self._clock = ReferenceClock(config.reentry.max_progress, config.reentry.progress_ramp)
        self._blocked = BlockedWatch(config.reentry.blocked_after)
        self._reference: Reference | None = None
        self._native = False
        self._top, self._top_speed = np.zeros((2, 2)), 0.0
        self._speed_limit = math.inf
        self.pace = math.inf
        """Largest progress rate for the path ahead, set before each tick [-]."""
        self.planned_delay = 0.0
        """The part of `delay` that was decided: it stood, or went slowly for things ahead or a speed limit [s]."""
        self.room: Room | None = None
        """Where the robot may be on its way back, set before each tick; None: everywhere."""
        self.is_late = False
        """True from where the reference waits for a robot that lags until it has caught up."""
        self.limit = ""
        """Key of the limit that the robot was at when it fell behind; empty if at none."""
        self.configure(config)
        self.restart()

    def configure(self, config: ControllerConfig) -> None:
        """Use other limits from now on."""
        self._config, self._settings = config, config.reentry
        self._fastest = self._fastest_rate()

    def limit_speed(self, v: float | None) -> None:
        """Limit the forward speed along the reference to `v` [m/s] from now on; None: no limit."""
        self._speed_limit = math.inf if v is None else v

    def start(self, reference: Reference, *, native: bool) -> None:
        """Follow `reference` from now on; `native` is True if the core can sample it."""
        self._reference, self._native = reference, native
        samples = int(min(reference.duration / self._config.sample_time + 2.0, _MOST_SAMPLES))
        twist = reference.sample(np.linspace(0.0, reference.duration, samples)).twist
        # Forward, to the left; in reverse, to the right.
        self._top = np.array([twist.max(axis=0), -twist.min(axis=0)])
        self._top_speed = float(self._top[:, 0].max())
        self._fastest = self._fastest_rate()
        self.restart()

    def restart(self) -> None:
        """Restart with the same reference, on time."""
        self._clock.restart()
        self._blocked.restart()
        self._way_back: Rejoin | None = None
        self._reason = ""
        self._driving, self._resumes = True, False
        self._time = -math.inf
        self.planned_delay, self._slows_down = 0.0, False
        self.is_late, self.limit = False, ""

    def switch_reference(self, reference: Reference, *, native: bool) -> None:
        """Follow `reference`, the current one transformed by a pose; drop any way back, which led to the old place."""
        self._reference, self._native = reference, native
        self._way_back = None

    @property
    def on_time(self) -> bool:
        """True if the robot may follow the reference unmodified, provided that it has not left its path since."""
        if not self._settings.enabled:
            return self._native
        free = self._top_speed <= _KEPT * self._speed_limit
        return self._native and self._driving and self._way_back is None and self._clock.on_time and free

    def passed(self, since_start: float, *, followed: bool) -> None:
        """Record a tick at `since_start` [s] that was on time; `followed` is True if the robot was driving."""
        if self._settings.enabled:
            self._clock.pass_by(since_start)
            self._time, self._resumes = since_start, False
            self._blocked.restart()
        self._driving = followed

    @property
    def progress(self) -> float:
        """Rate of the reference's clock [-]."""
        if not self._settings.enabled:
            return 1.0
        return self._clock.rate if self._driving else 0.0

    @property
    def delay(self) -> float:
        """Delay of the reference's clock behind the controller's [s]."""
        return self._clock.delay

    @property
    def reference(self) -> Reference | None:
        """Pursued reference: the reference of the drive, or the path back to it."""
        return self._way_back or self._reference

    @property
    def time(self) -> float:
        """Time of the reference at the last tick [s]; minus infinity before the first."""
        return self._time

    def stand(self) -> None:
        """Stand after braking by another part; the reference waits until it is followed again."""
        self._driving = False

    def advance(self, since_start: float) -> float:
        """Advance to `since_start` [s] on the controller's clock; return the reference's time [s].

        The reference's clock stops while `target` is not called, since the robot does not follow it then.
        """
        if not self._settings.enabled:
            return since_start
        ended = self._reference is not None and self._time >= self._reference.duration
        if ended and not self._driving:
            self._clock.run_on()
        before, driving = self._clock.delay, self._driving or ended
        self._time = self._clock.advance(since_start, driving=driving)
        self._count_delay(before, driving=driving)
        self._resumes, self._driving = not self._driving, False
        return self._time

    def _count_delay(self, before: float, *, driving: bool) -> None:
        """Add the planned part of the delay since it was `before` [s]; a robot that lags is not counted."""
        delay = self._clock.delay
        if not driving or self._slows_down:
            self.planned_delay += max(0.0, delay - before)
        # Caught-up time is no longer a delay.
        self.planned_delay = min(self.planned_delay, max(0.0, delay))

    def target(
        self,
        since_start: float,
        time: float,
        estimate: Estimate,
        ahead: FloatArray = _NOW,
        reach: float = math.inf,
    ) -> Target | TooFar:
        """Return the target at `since_start` [s], where `time` [s] is the value that `advance` returned.

        `ahead` are the times from now, 0 first, at which the target will be sampled, so that the reference is sampled
        only once. `reach` is the rim speed that may be demanded of the wheels [m/s].
        """
        reference = self._reference
        assert reference is not None
        if not self._settings.enabled or since_start < 0.0:
            return self._chase(reference, time, estimate)
        if self._resumes:
            # The robot was not commanded to move until now.
            self._blocked.restart()
        if self._way_back is not None and time >= self._way_back.joins:
            self._way_back = None
        followed: Reference = self._way_back or reference
        sample = followed.sample(time + ahead)
        off, v = self._stray(sample)
        if off.outside:
            way_back = self._return(reference, time, since_start, estimate, sample.pose[0])
            if isinstance(way_back, TooFar | StandingReference):
                no_way = "no way: nothing free leads back to the path; waits"
                return Target(way_back, since_start, no_way) if isinstance(way_back, StandingReference) else way_back
            if way_back is not None:
                self._way_back = followed = way_back
                time = way_back.begins
                self._clock.set(since_start - time, 1.0)
                sample = followed.sample(time + ahead)
                off, v = self._stray(sample)
        elif self._resumes and abs(v) > STANDING:
            self._clock.set(self._clock.delay, min(1.0, max(0.0, float(estimate.twist[0]) / v)))
        self._driving = True
        late = float(off.late)
        within = self._within_reach(reach, sample.twist[ahead <= _LOOK], estimate.slip.yaw_gain)
        most = min(self._fastest * min(1.0, max(0.0, 2.0 - late)), within)
        chosen = self.pace
        if math.isfinite(self._speed_limit):
            chosen = min(chosen, self._within_limit(float(np.abs(sample.twist[ahead <= _LOOK, 0]).max())))
        self._slows_down, most = chosen < 1.0, min(most, chosen)
        self._clock.plan(most, catch_up=self._way_back is None)
        if late <= 1.0 and self._way_back is None:
            self._blocked.restart()
            if self._clock.on_time:
                self.is_late, self.limit = False, ""
                return Target(followed, time, sample=sample)
        still = self._blocked.look(since_start, estimate.pose) if late > 1.0 or self._way_back else 0.0
        self._count_lag(lags=late > 1.0 and self._way_back is None and not still)
        words = self._words(still)
        if self._top_speed > _KEPT * self._speed_limit:
            words = "; ".join(filter(None, [f"limited to {self._speed_limit:.2f} m/s", words]))
        if within < 1.0:
            words += f"; the wheels get no faster than {reach:.2f} m/s"
        return Target(self._clock.clocked(followed), since_start, words, still)

    def _count_lag(self, *, lags: bool) -> None:
        if lags:
            self.is_late, self.limit = True, self._limited_by() or self.limit

    def _within_reach(self, reach: float, twist: FloatArray, yaw_gain: float) -> float:
        """Limit the progress rate so that the upcoming twists (n, 2) need at most the rim speed `reach` [m/s].

        The body turns `yaw_gain` times as fast as its wheels, which counts in turns on the spot only. A limit learned
        in such a turn does not apply to the path after it, and vice versa.
        """
        if not math.isfinite(reach):
            return math.inf
        v, turning = np.abs(twist * [1.0, 0.5 * self._config.wheels.track]).T
        on_spot = v < _ON_SPOT * turning
        needed = (v + turning / yaw_gain)[on_spot == on_spot[0]]
        return _USABLE * reach / max(float(needed.max()), STANDING)

    def _within_limit(self, fastest: float) -> float:
        """Limit the progress rate of a reference that reaches `fastest` [m/s] by at most `v_acceleration`."""
        fastest = max(fastest, STANDING)
        slowed = self._clock.rate - self._settings.v_acceleration / fastest * self._config.sample_time
        return max(_KEPT * self._speed_limit / fastest, slowed)

    def _chase(self, reference: Reference, time: float, estimate: Estimate) -> Target | TooFar:
        """Track the reference on time, independent of the robot."""
        start = reference.sample([time]).pose[0]
        distance = float(np.hypot(*(estimate.pose - start)[:2]))
        self._driving = distance <= self._config.failure.max_position_error
        return Target(reference, time) if self._driving else TooFar(distance)

    def _stray(self, sample: ReferenceSample) -> tuple[Stray, float]:
        """Return the robot's deviation from the first pose of `sample`, and the forward speed there [m/s]."""
        twist = sample.twist[0]
        return self._stray_from(sample.pose[0], twist), float(twist[0])

    def _displaced(self, ahead: float) -> bool:
        """Return True if `ahead` [m] along the path exceeds what the waiting of the reference explains."""
        return not -BEHIND * self._settings.wait <= ahead <= AHEAD * self._settings.wait

    def _return(
        self, reference: Reference, time: float, since_start: float, estimate: Estimate, waiting: FloatArray
    ) -> Rejoin | TooFar | StandingReference | None:
        """Plan a path back; return `StandingReference` if there is no room for one.

        Returns None if the robot is on its path after all, only earlier or later than the reference.
        """
        settings = self._settings
        away = float(np.hypot(*(estimate.pose - waiting)[:2]))
        # A displacement without driving is no progress: it counts from `waiting`, the place where the reference waits.
        if self._resumes and away > self._config.failure.max_position_error:
            return TooFar(away)
        window = PathWindow.around(reference, time, settings.window, _WINDOW_STEP * self._config.sample_time)
        waited = self._resumes and self._way_back is None
        nearest = window.index(time) if waited else window.nearest(estimate.pose, time)
        along, across = window.beside(estimate.pose, nearest)
        distance = math.hypot(along, across)
        if distance > self._config.failure.max_position_error:
            return TooFar(distance)
        turned = abs(float(wrap_angle(estimate.pose[2] - window.pose[nearest, 2])))
        moved = float(window.arc_length[nearest] - np.interp(time, window.times, window.arc_length))
        # As in mpc/core/tick.c.
        band = max(settings.band, _UNSURE * math.hypot(*estimate.pose_deviation[:2]))
        beside, aside = distance > band, turned > settings.heading_band
        displaced = self._displaced(moved)
        if self._way_back is None and not (beside or aside or displaced):
            return None
        path = rejoin(
            reference,
            window,
            nearest,
            Course(estimate.pose, float(estimate.twist[0]), float(estimate.twist[1])),
            since_start,
            (settings.min_look_ahead, settings.max_look_ahead),
            self._limits(),
            self.room,
        )
        if path is None:
            return StandingReference(estimate.pose)
        self._count_lag(lags=not (self._way_back or self._resumes) and bool(self._limited_by()))
        if beside or not (aside or displaced):
            reason = f"outside the band by {max(0.0, distance - band):.2f} m"
        else:
            reason = f"turned by {turned:.1f} rad" if aside else f"carried {moved:+.2f} m along the path"
        self._reason = f"{reason}: rejoining {path.ahead:.2f} m ahead"
        return path

    def _fastest_rate(self) -> float:
        """Compute the progress rate up to which the reference stays inside the limits of the command."""
        limits = self._config.limits
        sides = np.transpose([limits.v.sides, limits.omega.sides])
        shares = sides / np.maximum(self._top, [STANDING, TURNING])
        # A low limit should stop the reference where it is exceeded, not slow it everywhere.
        within = float(shares[shares > _KEPT].min(initial=math.inf))
        return max(1.0, min(self._settings.max_progress, within))

    def _limits(self) -> TrajectoryLimits:
        """Compute the limits of the path back: slightly faster than the reference itself."""
        settings, limits = self._settings, self._config.limits
        cruise = settings.max_progress * self._top_speed if self._top_speed > STANDING else max(limits.v.sides)
        return TrajectoryLimits(
            v=limits.v.map(lambda side: min(cruise, settings.effort * side, _KEPT * self._speed_limit)),
            omega=limits.omega.map(lambda side: settings.effort * side),
            v_acceleration=settings.v_acceleration,
            omega_acceleration=settings.omega_acceleration,
            min_turn_radius=limits.least_radius_of_ways,
        )

    def _words(self, still: float) -> str:
        words = [f"blocked for {still:.1f} s"] if still else []
        if self._way_back is not None:
            words.append(self._reason)
        rate, delay = self._clock.rate, self._clock.delay
        if rate < 1.0 and delay >= 0.0:
            words.append(f"the reference waits, {delay:.1f} s late")
        elif delay != 0.0 and self._way_back is None:
            words.append(
                "the reference is late and catches up" if delay > 0.0 else "the reference is early and slows down"
            )
        if words and self.limit:
            words.append(f"at {self.limit}")
        return "; ".join(words)
