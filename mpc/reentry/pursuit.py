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
from diffdrive_mpc.mpc.reentry.options import RobotState
from diffdrive_mpc.mpc.reentry.path_window import PathWindow
from diffdrive_mpc.mpc.reentry.reference_clock import ReferenceClock
from diffdrive_mpc.mpc.reentry.rejoin import Rejoin, Room, rejoin
from diffdrive_mpc.mpc.reentry.target import BlockedWatch, StandingReference, Target, TooFar
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits

# Steps of the window in samples of the controller.
_WINDOW_STEP = 2.5
_MAX_SAMPLES = 5000
_NOW = np.zeros(1)
# Share of the attainable wheel speed for the reference, with a reserve for path corrections [-]; and the time ahead for
# which the reference is checked against it [s].
_WHEEL_SHARE, _CHECKED_TIME = 0.85, 0.6
# As in mpc/config/sensor_test.yaml.
_ON_SPOT = 0.5
# Share of a speed limit for the reference, with a reserve for path corrections [-].
_LIMIT_SHARE = 0.95
# Minimum width of the band, in standard deviations of the position.
_MIN_BAND = 3.0


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
    """Choice of the target for one reference, with the reference's clock and the path back, if there is one.

    Parameters
    ----------
    config
        Limits, and the groups `reentry` and `failure`.
    stray
        Function that returns the robot's deviation from a reference pose (3,) with twist (2,).
    limited_by
        Function that returns the key of the costliest limit of the last plan; empty if no limit was active.
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
        """Maximum progress rate for the path ahead, set before each tick [-]."""
        self.planned_delay = 0.0
        """Planned part of `delay`, by standstill, obstacles ahead or a speed limit [s]."""
        self.room: Room | None = None
        """Check for free space along the path back, set before each tick; None: no obstacles."""
        self.is_late = False
        """True from the time when the reference waits for a lagging robot until the robot has caught up."""
        self.limit = ""
        """Key of the limit that caused the lag; empty if there is none."""
        self.configure(config)
        self.restart()

    def configure(self, config: ControllerConfig) -> None:
        """Use the limits of `config` from the next tick on."""
        self._config, self._settings = config, config.reentry
        self._fastest = self._fastest_rate()

    def limit_speed(self, v: float | None) -> None:
        """Limit the forward speed along the reference to `v` [m/s] from the next tick on; None: no limit."""
        self._speed_limit = math.inf if v is None else v

    def start(self, reference: Reference, *, native: bool) -> None:
        """Start to track `reference`; `native` is True if the core can sample it."""
        self._reference, self._native = reference, native
        samples = int(min(reference.duration / self._config.sample_time + 2.0, _MAX_SAMPLES))
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
        self._return_path: Rejoin | None = None
        self._reason = ""
        self._driving, self._resumes = True, False
        self._time = -math.inf
        self.planned_delay, self._slows_down = 0.0, False
        self.is_late, self.limit = False, ""

    def switch_reference(self, reference: Reference, *, native: bool) -> None:
        """Continue with `reference`, the current one transformed by a pose; discard a path back, which is outdated."""
        self._reference, self._native = reference, native
        self._return_path = None

    @property
    def on_time(self) -> bool:
        """True if a robot that is still on its path may track the unmodified reference."""
        if not self._settings.enabled:
            return self._native
        free = self._top_speed <= _LIMIT_SHARE * self._speed_limit
        return self._native and self._driving and self._return_path is None and self._clock.on_time and free

    def record_on_time(self, since_start: float, *, followed: bool) -> None:
        """Record a tick on time at `since_start` [s]; `followed` is True if the robot was driving."""
        if self._settings.enabled:
            self._clock.record_on_time(since_start)
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
        return self._return_path or self._reference

    @property
    def time(self) -> float:
        """Time of the reference at the last tick [s]; minus infinity before the first tick."""
        return self._time

    def stand(self) -> None:
        """Let the reference wait, after another part has braked, until it is tracked again."""
        self._driving = False

    def advance(self, since_start: float) -> float:
        """Advance to `since_start` [s] on the controller's clock; return the reference's time [s].

        The reference's clock stops while `target` is not called, since the robot does not follow it then.
        """
        if not self._settings.enabled:
            return since_start
        ended = self._reference is not None and self._time >= self._reference.duration
        if ended and not self._driving:
            self._clock.keep_delay()
        before, driving = self._clock.delay, self._driving or ended
        self._time = self._clock.advance(since_start, driving=driving)
        self._count_delay(before, driving=driving)
        self._resumes, self._driving = not self._driving, False
        return self._time

    def _count_delay(self, before: float, *, driving: bool) -> None:
        """Add the planned increase of the delay from `before` [s]; an increase by a lagging robot is not counted."""
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
        """Return the target at `since_start` [s]; `time` [s] is the result of `advance`.

        `ahead` are the times from the current tick, 0 first, for which the caller needs samples of the target, so that
        the reference is sampled only once. `reach` is the maximum usable rim speed of the wheels [m/s].
        """
        reference = self._reference
        assert reference is not None
        if not self._settings.enabled or since_start < 0.0:
            return self._track_on_time(reference, time, estimate)
        if self._resumes:
            # The robot was not commanded to move until now.
            self._blocked.restart()
        if self._return_path is not None and time >= self._return_path.joins:
            self._return_path = None
        followed: Reference = self._return_path or reference
        sample = followed.sample(time + ahead)
        stray, v = self._stray(sample)
        if stray.outside:
            path = self._return(reference, time, since_start, estimate, sample.pose[0])
            if isinstance(path, TooFar | StandingReference):
                no_way = "no way: nothing free leads back to the path; waits"
                return Target(path, since_start, no_way) if isinstance(path, StandingReference) else path
            if path is not None:
                self._return_path = followed = path
                time = path.begins
                self._clock.set(since_start - time, 1.0)
                sample = followed.sample(time + ahead)
                stray, v = self._stray(sample)
        elif self._resumes and abs(v) > STANDING:
            self._clock.set(self._clock.delay, min(1.0, max(0.0, float(estimate.twist[0]) / v)))
        self._driving = True
        lag = float(stray.late)
        wheel_rate = self._wheel_rate(reach, sample.twist[ahead <= _CHECKED_TIME], estimate.slip.yaw_gain)
        max_rate = min(self._fastest * min(1.0, max(0.0, 2.0 - lag)), wheel_rate)
        chosen = self.pace
        if math.isfinite(self._speed_limit):
            chosen = min(chosen, self._speed_limit_rate(float(np.abs(sample.twist[ahead <= _CHECKED_TIME, 0]).max())))
        self._slows_down, max_rate = chosen < 1.0, min(max_rate, chosen)
        self._clock.plan(max_rate, catch_up=self._return_path is None)
        if lag <= 1.0 and self._return_path is None:
            self._blocked.restart()
            if self._clock.on_time:
                self.is_late, self.limit = False, ""
                return Target(followed, time, sample=sample)
        still = self._blocked.update(since_start, estimate.pose) if lag > 1.0 or self._return_path else 0.0
        self._record_lag(lags=lag > 1.0 and self._return_path is None and not still)
        words = self._describe(still)
        if self._top_speed > _LIMIT_SHARE * self._speed_limit:
            words = "; ".join(filter(None, [f"limited to {self._speed_limit:.2f} m/s", words]))
        if wheel_rate < 1.0:
            words += f"; the wheels get no faster than {reach:.2f} m/s"
        return Target(self._clock.clocked(followed), since_start, words, still)

    def _record_lag(self, *, lags: bool) -> None:
        if lags:
            self.is_late, self.limit = True, self._limited_by() or self.limit

    def _wheel_rate(self, reach: float, twist: FloatArray, yaw_gain: float) -> float:
        """Return the progress rate at which the upcoming twists (n, 2) need a rim speed of at most `reach` [m/s].

        The body turns `yaw_gain` times as fast as its wheels, which matters in turns on the spot only. A limit learned
        in such a turn does not apply to the path after it, and vice versa.
        """
        if not math.isfinite(reach):
            return math.inf
        v, turning = np.abs(twist * [1.0, 0.5 * self._config.wheels.track]).T
        on_spot = v < _ON_SPOT * turning
        needed = (v + turning / yaw_gain)[on_spot == on_spot[0]]
        return _WHEEL_SHARE * reach / max(float(needed.max()), STANDING)

    def _speed_limit_rate(self, v: float) -> float:
        """Return the progress rate for a reference with maximum speed `v` [m/s], slowing by `v_acceleration`."""
        v = max(v, STANDING)
        reachable = self._clock.rate - self._settings.v_acceleration / v * self._config.sample_time
        return max(_LIMIT_SHARE * self._speed_limit / v, reachable)

    def _track_on_time(self, reference: Reference, time: float, estimate: Estimate) -> Target | TooFar:
        """Track the reference on time, independent of the robot."""
        start = reference.sample([time]).pose[0]
        distance = float(np.hypot(*(estimate.pose - start)[:2]))
        self._driving = distance <= self._config.failure.max_position_error
        return Target(reference, time) if self._driving else TooFar(distance)

    def _stray(self, sample: ReferenceSample) -> tuple[Stray, float]:
        """Return the robot's deviation from the first pose of `sample`, and the forward speed there [m/s]."""
        twist = sample.twist[0]
        return self._stray_from(sample.pose[0], twist), float(twist[0])

    def _is_displaced(self, ahead: float) -> bool:
        """Return True if `ahead` [m] along the path is larger than the waiting of the reference can explain."""
        return not -BEHIND * self._settings.wait <= ahead <= AHEAD * self._settings.wait

    def _return(
        self, reference: Reference, time: float, since_start: float, estimate: Estimate, waiting: FloatArray
    ) -> Rejoin | TooFar | StandingReference | None:
        """Plan a path back; return `StandingReference` if no path is free.

        Returns None if the robot is on its path, only earlier or later than the reference.
        """
        settings = self._settings
        away = float(np.hypot(*(estimate.pose - waiting)[:2]))
        # A displacement without driving is no progress: it is measured from `waiting`, the pose of the waiting
        # reference.
        if self._resumes and away > self._config.failure.max_position_error:
            return TooFar(away)
        window = PathWindow.sample_around(reference, time, settings.window, _WINDOW_STEP * self._config.sample_time)
        waited = self._resumes and self._return_path is None
        nearest = window.index(time) if waited else window.nearest(estimate.pose, time)
        along, across = window.position_at(estimate.pose, nearest)
        distance = math.hypot(along, across)
        if distance > self._config.failure.max_position_error:
            return TooFar(distance)
        turned = abs(float(wrap_angle(estimate.pose[2] - window.pose[nearest, 2])))
        moved = float(window.arc_length[nearest] - np.interp(time, window.times, window.arc_length))
        # As in mpc/core/tick.c.
        band = max(settings.band, _MIN_BAND * math.hypot(*estimate.pose_deviation[:2]))
        is_outside, is_turned = distance > band, turned > settings.heading_band
        is_displaced = self._is_displaced(moved)
        if self._return_path is None and not (is_outside or is_turned or is_displaced):
            return None
        path = rejoin(
            reference,
            window,
            nearest,
            RobotState(estimate.pose, float(estimate.twist[0]), float(estimate.twist[1])),
            since_start,
            (settings.min_look_ahead, settings.max_look_ahead),
            self._limits(),
            self.room,
        )
        if path is None:
            return StandingReference(estimate.pose)
        self._record_lag(lags=not (self._return_path or self._resumes) and bool(self._limited_by()))
        if is_outside or not (is_turned or is_displaced):
            reason = f"outside the band by {max(0.0, distance - band):.2f} m"
        else:
            reason = f"turned by {turned:.1f} rad" if is_turned else f"carried {moved:+.2f} m along the path"
        self._reason = f"{reason}: rejoining {path.ahead:.2f} m ahead"
        return path

    def _fastest_rate(self) -> float:
        """Compute the maximum progress rate at which the reference stays within the limits of the command."""
        limits = self._config.limits
        sides = np.transpose([limits.v.sides, limits.omega.sides])
        shares = sides / np.maximum(self._top, [STANDING, TURNING])
        # A limit below the reference's own maximum applies only there, and must not slow the whole reference.
        limit_rate = float(shares[shares > _LIMIT_SHARE].min(initial=math.inf))
        return max(1.0, min(self._settings.max_progress, limit_rate))

    def _limits(self) -> TrajectoryLimits:
        """Compute the limits of the path back, on which the robot may be slightly faster than the reference."""
        settings, limits = self._settings, self._config.limits
        cruise = settings.max_progress * self._top_speed if self._top_speed > STANDING else max(limits.v.sides)
        return TrajectoryLimits(
            v=limits.v.map(lambda side: min(cruise, settings.effort * side, _LIMIT_SHARE * self._speed_limit)),
            omega=limits.omega.map(lambda side: settings.effort * side),
            v_acceleration=settings.v_acceleration,
            omega_acceleration=settings.omega_acceleration,
            min_turn_radius=limits.min_path_radius,
        )

    def _describe(self, still: float) -> str:
        words = [f"blocked for {still:.1f} s"] if still else []
        if self._return_path is not None:
            words.append(self._reason)
        rate, delay = self._clock.rate, self._clock.delay
        if rate < 1.0 and delay >= 0.0:
            words.append(f"the reference waits, {delay:.1f} s late")
        elif delay != 0.0 and self._return_path is None:
            words.append(
                "the reference is late and catches up" if delay > 0.0 else "the reference is early and slows down"
            )
        if words and self.limit:
            words.append(f"at {self.limit}")
        return "; ".join(words)
