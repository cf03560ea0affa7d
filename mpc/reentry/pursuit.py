"""Choice of the target at each tick: reference on time, waiting reference, or path back to the reference."""

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

# Step of the path window, in sample times of the controller [-].
_WINDOW_STEP = 2.5
# Maximum number of samples from which the maximum speeds of a reference are determined.
_MAX_SAMPLES = 5000
_CURRENT_TICK = np.zeros(1)
# Share of the attainable wheel speed that the reference may use [-], with a reserve for path corrections. Time ahead
# for which the wheel speeds of the reference are checked [s].
_WHEEL_SHARE, _PREVIEW_TIME = 0.85, 0.6
# Ratio of body speed to half the wheel speed difference below which the robot turns on the spot [-]; the same value as
# in mpc/config/sensor_test.yaml.
_ON_SPOT = 0.5
# Share of a speed limit that the reference may use [-], with a reserve for path corrections.
_LIMIT_SHARE = 0.95
# Minimum width of the band, in standard deviations of the position [-].
_BAND_DEVIATIONS = 3.0


class Stray(Protocol):
    """Deviation of the robot from a reference pose."""

    @property
    def outside(self) -> bool:
        """True if the robot is outside the band around its path, or was displaced along its path."""
        ...

    @property
    def late(self) -> float:
        """Lag behind the reference, divided by the lag at which the reference starts to wait [-]."""
        ...


class Pursuit:
    """Selector of the target, with the reference's clock and the current path back to the reference.

    Parameters
    ----------
    config
        Configuration; the limits and the groups `reentry` and `failure` are used.
    stray
        Function that returns the robot's deviation from a reference pose (3,) with twist (2,).
    limited_by
        Function that returns the key of the costliest limit of the last plan; an empty key if no limit was active.
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
        self._max_twists, self._max_speed = np.zeros((2, 2)), 0.0
        self._speed_limit = math.inf
        self.pace = math.inf
        """Maximum progress rate for the path ahead [-]; set before each tick."""
        self.planned_delay = 0.0
        """Part of `delay` that was planned because of a standstill, obstacles ahead or a speed limit [s]."""
        self.room: Room | None = None
        """Check for free space along a path back, set before each tick; None if there are no obstacles."""
        self.is_late = False
        """True from the tick at which the reference starts to wait for a lagging robot until the robot catches up."""
        self.limit = ""
        """Key of the limit that caused the lag; empty if no limit caused a lag."""
        self.configure(config)
        self.restart()

    def configure(self, config: ControllerConfig) -> None:
        """Use the limits of `config` from the next tick on."""
        self._config, self._settings = config, config.reentry
        self._max_progress_rate = self._compute_max_rate()

    def limit_speed(self, v: float | None) -> None:
        """Limit the speed along the reference to `v` [m/s] from the next tick on; None removes the limit."""
        self._speed_limit = math.inf if v is None else v

    def start(self, reference: Reference, *, native: bool) -> None:
        """Start to track `reference`; `native` is True if the core can sample it."""
        self._reference, self._native = reference, native
        samples = int(min(reference.duration / self._config.sample_time + 2.0, _MAX_SAMPLES))
        twist = reference.sample(np.linspace(0.0, reference.duration, samples)).twist
        # Row 0: maximum forward speed and left yaw rate; row 1: maximum reverse speed and right yaw rate.
        self._max_twists = np.array([twist.max(axis=0), -twist.min(axis=0)])
        self._max_speed = float(self._max_twists[:, 0].max())
        self._max_progress_rate = self._compute_max_rate()
        self.restart()

    def restart(self) -> None:
        """Restart the current reference without delay."""
        self._clock.restart()
        self._blocked.restart()
        self._return_path: Rejoin | None = None
        self._reason = ""
        self._driving, self._resumes = True, False
        self._time = -math.inf
        self.planned_delay, self._slows_down = 0.0, False
        self.is_late, self.limit = False, ""

    def switch_reference(self, reference: Reference, *, native: bool) -> None:
        """Continue with `reference`, the current reference transformed by a pose, and discard an outdated path back."""
        self._reference, self._native = reference, native
        self._return_path = None

    @property
    def on_time(self) -> bool:
        """True if the core can track the unmodified reference, provided that the robot is on its path."""
        if not self._settings.enabled:
            return self._native
        is_within_limit = self._max_speed <= _LIMIT_SHARE * self._speed_limit
        is_unmodified = self._return_path is None and self._clock.on_time and is_within_limit
        return self._native and self._driving and is_unmodified

    def record_on_time(self, since_start: float, *, tracked: bool) -> None:
        """Record a tick with the unmodified reference at `since_start` [s]; `tracked` is True if the robot drove."""
        if self._settings.enabled:
            self._clock.record_on_time(since_start)
            self._time, self._resumes = since_start, False
            self._blocked.restart()
            if tracked:
                self.is_late, self.limit = False, ""
        self._driving = tracked

    @property
    def progress(self) -> float:
        """Rate of the reference's clock [-]."""
        if not self._settings.enabled:
            return 1.0
        return self._clock.rate if self._driving else 0.0

    @property
    def delay(self) -> float:
        """Delay of the reference's clock behind the controller's clock [s]."""
        return self._clock.delay

    @property
    def reference(self) -> Reference | None:
        """Currently tracked reference: the reference of the drive, or a path back to that reference."""
        return self._return_path or self._reference

    @property
    def time(self) -> float:
        """Time of the reference at the last tick [s]; minus infinity before the first tick."""
        return self._time

    def stand(self) -> None:
        """Stop the reference's clock until the next call of `target`, since another component brakes the robot."""
        self._driving = False

    def advance(self, since_start: float) -> float:
        """Advance to `since_start` [s] on the controller's clock; return the reference's time [s].

        The reference's clock stops while `target` is not called, because the robot then does not track the reference.
        """
        if not self._settings.enabled:
            return since_start
        has_ended = self._reference is not None and self._time >= self._reference.duration
        if has_ended and not self._driving:
            self._clock.keep_delay()
        previous_delay, driving = self._clock.delay, self._driving or has_ended
        self._time = self._clock.advance(since_start, driving=driving)
        self._count_delay(previous_delay, driving=driving)
        self._resumes, self._driving = not self._driving, False
        return self._time

    def _count_delay(self, previous_delay: float, *, driving: bool) -> None:
        """Add the increase from `previous_delay` [s] to the planned delay, unless a lagging robot caused it."""
        delay = self._clock.delay
        if not driving or self._slows_down:
            self.planned_delay += max(0.0, delay - previous_delay)
        # The planned part cannot exceed the delay, which decreases while the reference catches up.
        self.planned_delay = min(self.planned_delay, max(0.0, delay))

    def target(
        self,
        since_start: float,
        time: float,
        estimate: Estimate,
        ahead: FloatArray = _CURRENT_TICK,
        reach: float = math.inf,
    ) -> Target | TooFar:
        """Return the target at `since_start` [s]; `time` [s] is the result of `advance`.

        `ahead` (n,) are the times after the current tick [s], starting with 0, at which the target is sampled. `reach`
        is the maximum attainable rim speed of the wheels [m/s].
        """
        reference = self._reference
        assert reference is not None
        if not self._settings.enabled or since_start < 0.0:
            return self._track_on_time(reference, time, estimate)
        if self._resumes:
            # The robot had no motion command before this tick, so its standstill does not count.
            self._blocked.restart()
        if self._return_path is not None and time >= self._return_path.joins:
            self._return_path = None
        tracked: Reference = self._return_path or reference
        sample = tracked.sample(time + ahead)
        stray, v = self._stray(sample)
        if stray.outside:
            path = self._plan_return(reference, time, since_start, estimate, sample.pose[0])
            if isinstance(path, TooFar | StandingReference):
                message = "no way: no free path leads back to the reference; waits"
                return Target(path, since_start, message) if isinstance(path, StandingReference) else path
            if path is not None:
                self._return_path = tracked = path
                time = path.starts
                self._clock.set(since_start - time, 1.0)
                sample = tracked.sample(time + ahead)
                stray, v = self._stray(sample)
        elif self._resumes and abs(v) > STANDING:
            # The clock resumes at the rate that matches the speed of the robot, so that the robot does not jerk.
            self._clock.set(self._clock.delay, min(1.0, max(0.0, float(estimate.twist[0]) / v)))
        self._driving = True
        lag = float(stray.late)
        wheel_rate = self._wheel_rate(reach, sample.twist[ahead <= _PREVIEW_TIME], estimate.slip.yaw_gain)
        # The maximum rate decreases linearly with the lag: full up to a lag of 1, zero from a lag of 2 on.
        max_rate = min(self._max_progress_rate * min(1.0, max(0.0, 2.0 - lag)), wheel_rate)
        planned_rate = self.pace
        if math.isfinite(self._speed_limit):
            max_speed = float(np.abs(sample.twist[ahead <= _PREVIEW_TIME, 0]).max())
            planned_rate = min(planned_rate, self._speed_limit_rate(max_speed))
        self._slows_down, max_rate = planned_rate < 1.0, min(max_rate, planned_rate)
        self._clock.plan(max_rate, catch_up=self._return_path is None)
        if lag <= 1.0 and self._return_path is None:
            self._blocked.restart()
            if self._clock.on_time:
                self.is_late, self.limit = False, ""
                return Target(tracked, time, sample=sample)
        blocked_for = self._blocked.update(since_start, estimate.pose) if lag > 1.0 or self._return_path else 0.0
        self._record_lag(lags=lag > 1.0 and self._return_path is None and not blocked_for)
        message = self._describe(blocked_for)
        if self._max_speed > _LIMIT_SHARE * self._speed_limit:
            message = "; ".join(filter(None, [f"limited to {self._speed_limit:.2f} m/s", message]))
        if wheel_rate < 1.0:
            message += f"; the wheels get no faster than {reach:.2f} m/s"
        return Target(self._clock.apply(tracked), since_start, message, blocked_for)

    def _record_lag(self, *, lags: bool) -> None:
        if lags:
            self.is_late, self.limit = True, self._limited_by() or self.limit

    def _wheel_rate(self, reach: float, twist: FloatArray, yaw_gain: float) -> float:
        """Compute the progress rate at which the next twists (n, 2) require a rim speed of at most `reach` [m/s].

        The yaw rate of the body is `yaw_gain` times that of the wheels. A wheel speed limit that was learned in a turn
        on the spot does not apply to the path after the turn, and vice versa.
        """
        if not math.isfinite(reach):
            return math.inf
        v, turning = np.abs(twist * [1.0, 0.5 * self._config.wheels.track]).T
        on_spot = v < _ON_SPOT * turning
        rim_speed = (v + turning / yaw_gain)[on_spot == on_spot[0]]
        return _WHEEL_SHARE * reach / max(float(rim_speed.max()), STANDING)

    def _speed_limit_rate(self, v: float) -> float:
        """Compute the progress rate that keeps the speed limit if the reference has the speed `v` [m/s].

        The rate decreases at most as fast as `v_acceleration` permits.
        """
        v = max(v, STANDING)
        reachable = self._clock.rate - self._settings.v_acceleration / v * self._config.sample_time
        return max(_LIMIT_SHARE * self._speed_limit / v, reachable)

    def _track_on_time(self, reference: Reference, time: float, estimate: Estimate) -> Target | TooFar:
        """Return the reference without delay as the target, independent of the lag of the robot."""
        start = reference.sample([time]).pose[0]
        distance = float(np.hypot(*(estimate.pose - start)[:2]))
        self._driving = distance <= self._config.failure.max_position_error
        return Target(reference, time) if self._driving else TooFar(distance)

    def _stray(self, sample: ReferenceSample) -> tuple[Stray, float]:
        """Return the robot's deviation from the first pose of `sample`, and the speed of the reference at it [m/s]."""
        twist = sample.twist[0]
        return self._stray_from(sample.pose[0], twist), float(twist[0])

    def _plan_return(
        self, reference: Reference, time: float, since_start: float, estimate: Estimate, waiting: FloatArray
    ) -> Rejoin | TooFar | StandingReference | None:
        """Plan a path back from the robot; `waiting` (3,) is the pose of the waiting reference.

        Returns None if the robot is on its path, but ahead or behind; `StandingReference` if no path is free; and
        `TooFar` if the robot is too far from its path.
        """
        settings = self._settings
        displacement = float(np.hypot(*(estimate.pose - waiting)[:2]))
        # A displacement without a motion command is not progress along the path, so its distance from the waiting
        # reference is limited.
        if self._resumes and displacement > self._config.failure.max_position_error:
            return TooFar(displacement)
        window = PathWindow.sample_around(reference, time, settings.window, _WINDOW_STEP * self._config.sample_time)
        has_waited = self._resumes and self._return_path is None
        nearest = window.index(time) if has_waited else window.nearest(estimate.pose, time)
        along, across = window.position_at(estimate.pose, nearest)
        distance = math.hypot(along, across)
        if distance > self._config.failure.max_position_error:
            return TooFar(distance)
        heading_error = abs(float(wrap_angle(estimate.pose[2] - window.pose[nearest, 2])))
        lead = float(window.arc_length[nearest] - np.interp(time, window.times, window.arc_length))
        # The width of the band is computed as in mpc/core/tick.c.
        band = max(settings.band, _BAND_DEVIATIONS * math.hypot(*estimate.pose_deviation[:2]))
        is_outside, is_turned = distance > band, heading_error > settings.heading_band
        is_displaced = not -BEHIND * settings.wait <= lead <= AHEAD * settings.wait
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
            reason = f"turned by {heading_error:.1f} rad" if is_turned else f"moved by {lead:+.2f} m along the path"
        self._reason = f"{reason}: rejoining {path.ahead:.2f} m ahead"
        return path

    def _compute_max_rate(self) -> float:
        """Compute the maximum progress rate at which the reference stays within the limits of the command."""
        limits = self._config.limits
        sides = np.transpose([limits.v.sides, limits.omega.sides])
        shares = sides / np.maximum(self._max_twists, [STANDING, TURNING])
        # A reference that exceeds a limit at some point must not slow down everywhere, so this limit is ignored.
        limit_rate = float(shares[shares > _LIMIT_SHARE].min(initial=math.inf))
        return max(1.0, min(self._settings.max_progress, limit_rate))

    def _limits(self) -> TrajectoryLimits:
        """Compute the limits of the path back; its speed may slightly exceed that of the reference."""
        settings, limits = self._settings, self._config.limits
        cruise = settings.max_progress * self._max_speed if self._max_speed > STANDING else max(limits.v.sides)
        return TrajectoryLimits(
            v=limits.v.map(lambda side: min(cruise, settings.effort * side, _LIMIT_SHARE * self._speed_limit)),
            omega=limits.omega.map(lambda side: settings.effort * side),
            v_acceleration=settings.v_acceleration,
            omega_acceleration=settings.omega_acceleration,
            min_turn_radius=limits.min_path_radius,
        )

    def _describe(self, blocked_for: float) -> str:
        parts = [f"blocked for {blocked_for:.1f} s"] if blocked_for else []
        if self._return_path is not None:
            parts.append(self._reason)
        rate, delay = self._clock.rate, self._clock.delay
        if rate < 1.0 and delay >= 0.0:
            parts.append(f"the reference waits, {delay:.1f} s late")
        elif delay != 0.0 and self._return_path is None:
            parts.append(
                "the reference is late and catches up" if delay > 0.0 else "the reference is early and slows down"
            )
        if parts and self.limit:
            parts.append(f"at {self.limit}")
        return "; ".join(parts)
