"""The dead time of each channel, learned while driving from commands and what wheels and gyro read.

The model without dead time is run on the commands sent. What the wheels read is compared with its answer as it would be
after each of a row of dead times, one sample apart; offset and gain are fitted for each, so that tracks and slip do not
matter:

    J(d) = min over a, g of  sum of w (y(t) - a - g x(t - d))^2

The sums forget, but only while there is something to learn from: where the answer does not change enough, all is
frozen. A parabola through the least three J gives the dead time; its curvature gives the deviation, 2 J / (n J'').

Which dead time the controller predicts with does not enter, so nothing feeds back on itself. What the model gets wrong
in lag looks like dead time, and is meant to: the whole lag is what a prediction needs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import CHANNELS, VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.core.tick import numbers
from diffdrive_mpc.mpc.features.feature import Feature
from diffdrive_mpc.mpc.step_result import LearnedDeadTime, Mode, StepResult

# Samples by which a reading may be late.
_LATEST = 5
# Over so many samples what the model gets wrong is alike: that many count as one.
_ALIKE = 5
# What the robot answers otherwise than the model is no dead time [-].
_LEAST_CORRELATION, _LEAST_GAIN, _MOST_GAIN = 0.95, 0.4, 2.5
# For so long after it was held, blocked or lost nothing is learned [s].
_RECOVERY = 0.5
# Dead times are compared up to so far beyond the bound [s].
_BEYOND = 0.08
# Nothing is faster [m/s, rad/s]: what is said to be so is not learned from, and no square overflows.
_FASTEST = 1e3
# Ticks from one estimate to the next.
_EVERY = 10


@dataclass
class _Clock:
    """Ticks as the model's answer counts them."""

    tick: float = np.nan
    since_trouble: float = np.inf
    changed: float = -np.inf
    ticks: int = 0


class DeadTimeEstimator:
    """Learns the dead time of v and omega, and says when to predict with another.

    Parameters
    ----------
    config
        Its group `online_dead_time`, and the sample time.
    model
        The model as configured, its dead time included.

    Attributes
    ----------
    lower, upper
        (2,) bounds of the dead time [s].
    longest
        The model with the longest dead time.
    used
        (2,) dead time that the controller predicts with [s].
    found
        What was learned; NaN of a channel that was not excited yet.
    """

    def __init__(self, config: ControllerConfig, model: VelocityModel) -> None:
        settings, dt = config.online_dead_time, config.sample_time
        self._settings, self._dt, self._sensors = settings, dt, config.sensors
        self.used = self._configured = model.dead_time
        self._model = replace(model, dead_time=np.zeros(2)).discretise(dt)
        self._drive = self._model.drive
        self.lower = np.maximum(model.dead_time - settings.shorter, 0.0)
        self.upper = model.dead_time + settings.longer
        self.longest = replace(model, dead_time=self.upper)
        # Whole samples of dead time that are compared, 0 to here: what is longer than allowed is recognised, too.
        self._longest = int(np.ceil((self.upper.max() + _BEYOND) / dt)) + 1
        self._least_change = self._longest * dt * np.array([settings.min_rate_v, settings.min_rate_omega])
        largest = [config.estimator.max_wheel_speed, config.estimator.max_yaw_rate]
        self._largest = np.minimum(largest, _FASTEST)
        self._keep = np.exp(-dt / settings.memory)
        self.forget()

    def forget(self) -> None:
        """Be as new, for a robot that stands still."""
        count = self._longest + 1
        self._state, self._sent = np.zeros(self._model.order), np.zeros(2)
        self._answer = np.zeros((count + _LATEST + 1, 2))
        # Sums of 1, x, x x, y, x y, y y by dead time and channel, and what a reading adds to them.
        self._sums, self._news = np.zeros((6, count, 2)), np.ones((6, count, 2))
        self._clock = _Clock()
        unknown = np.full(2, np.nan)
        self._gyro = False
        self._told = np.zeros(2, dtype=bool)
        self.found = LearnedDeadTime(unknown, unknown, self.used)

    def set_applied(self, command: FloatArray) -> None:
        """Somebody else decided the last command (2,)."""
        self._sent = command

    def take(self, t: float, measurement: Measurement, result: StepResult) -> bool:
        """Learn from the tick at `t` [s]: what arrived, and what answers to it; returns if `found` is new."""
        clock, dt = self._clock, self._dt
        gap = (t - clock.tick) / dt
        if abs(gap) < 0.5 or not math.isfinite(t):  # the same tick again, or none
            self._sent = result.command
            return False
        sent = None if measurement.sent is None else numbers(measurement.sent, 2)
        # Not the other way round: NaN must not pass.
        if sent is not None and (np.abs(sent) <= _FASTEST).all():
            self._sent = sent
        if not 0.0 < gap < len(self._answer):
            # The first tick, or a pause: the robot stands.
            self._state, self._sent = np.zeros_like(self._state), np.zeros(2)
            self._answer[:] = 0.0
            clock.since_trouble, clock.changed = math.inf if math.isnan(gap) else 0.0, -math.inf
            gap = 1.0
        driven = self._drive @ np.clip(self._sent, -_FASTEST, _FASTEST)
        for _ in range(round(gap)):
            self._state = self._model.A @ self._state + driven
            self._answer[:-1] = self._answer[1:]
            self._answer[-1] = self._model.C @ self._state
        clock.tick, self._sent = t, result.command
        fine = result.mode is Mode.TRACKING and result.blocked_for == 0.0
        clock.since_trouble = clock.since_trouble + dt if fine else 0.0
        if clock.since_trouble < _RECOVERY:
            return False
        self._learn(t, measurement, result.unused_sensors)
        clock.ticks += 1
        if clock.ticks % _EVERY:
            return False
        self._estimate()
        return True

    def _learn(self, t: float, measurement: Measurement, unused: tuple[str, ...]) -> None:
        wheels, gyro = measurement.wheel_twist, measurement.yaw_rate
        if wheels is not None and "wheel speed" not in unused:
            self._add(t + self._sensors.wheels.late, wheels, slice(0, 1) if self._gyro else slice(0, 2))
        elif gyro is not None and "yaw rate" not in unused and not self._sums[0, 0, 1] > 0.0:
            # A robot without wheel odometry. Its gain is another one: it is never mixed with that of wheels.
            self._gyro = True
        if self._gyro and gyro is not None and "yaw rate" not in unused:
            self._add(t + self._sensors.yaw_rate.late, gyro, slice(1, 2))

    def _add(self, t: float, reading: Stamped, channels: slice) -> None:
        """Add what was read at its stamp to the sums of the channels that change."""
        stamp, value = numbers(reading.time, 1), numbers(reading.value, 2 if channels.start == 0 else 1)
        if stamp is None or value is None:
            return
        late, value = max((t - float(stamp[0])) / self._dt, 0.0), value[: channels.stop - channels.start]
        # Not the other way round: NaN must not pass.
        sound = bool((np.abs(value) <= self._largest[channels]).all())
        if not (sound and late <= _LATEST):
            return
        whole = max(math.ceil(late), 1)
        newest = len(self._answer) - 1 - whole
        answer = self._answer[newest - self._longest : newest + 2, channels]
        older = answer[:-1]
        x = (older + (whole - late) * (answer[1:] - older))[::-1]
        changing = np.abs(x[0] - x[-1]) > self._least_change[channels]
        if not changing.any():
            return
        news, sums = self._news[:, :, channels], self._sums[:, :, channels]
        news[1], news[3], news[5] = x, value, value * value
        np.multiply(x, x, out=news[2])
        np.multiply(x, value, out=news[4])
        if changing.all():
            sums *= self._keep
            sums += news
        else:
            sums *= np.where(changing, self._keep, 1.0)
            sums += changing * news

    def _estimate(self) -> None:
        """The parabola about the least J of each channel."""
        dt, least = self._dt, round(_RECOVERY / self._dt)
        n = self._sums[0, 0]
        if not (n > least).any():
            return
        value, deviation = self.found.value.copy(), self.found.deviation.copy()
        weight, x, xx, y, xy, yy = self._sums
        with np.errstate(invalid="ignore", divide="ignore"):
            spread, common, power = xx - x * x / weight, xy - x * y / weight, yy - y * y / weight
            misfits, gains = power - common**2 / spread, common / spread
        for channel in np.flatnonzero(n > least):
            J = misfits[:, channel]
            j = min(max(int(np.argmin(J)), 1), self._longest - 1)
            curvature = J[j - 1] - 2 * J[j] + J[j + 1]
            fits = J[j] <= (1 - _LEAST_CORRELATION**2) * power[j, channel]
            if not (fits and curvature > 0 and _LEAST_GAIN <= gains[j, channel] <= _MOST_GAIN):
                continue
            dead_time = dt * (j + 0.5 * (J[j - 1] - J[j + 1]) / curvature)
            value[channel] = min(max(dead_time, self.lower[channel]), self.upper[channel])
            deviation[channel] = dt * np.sqrt(2 * max(J[j], 0.0) * _ALIKE / n[channel] / curvature)
        self.found = LearnedDeadTime(value, deviation, self.used)

    def wanted(self, t: float) -> FloatArray | None:
        """(2,) the dead time to predict with from now on [s]; None: go on with that in use."""
        settings = self._settings
        if not settings.apply or t - self._clock.changed < settings.pause:
            return None
        change = self._worth(self.used)
        if not change.any():
            return None
        self._clock.changed = t
        return np.asarray(self.used + np.clip(change, -settings.step, settings.step))

    def change(self, wanted: FloatArray | None) -> str:
        """In words that the dead time becomes `wanted` (2,) [s]; empty if it stays."""
        changes = [
            f"{name} {before:.3f} to {after:.3f} s"
            for name, before, after in zip(CHANNELS, self.used, self.used if wanted is None else wanted, strict=True)
            if before != after
        ]
        return f"dead time: {', '.join(changes)}" if changes else ""

    def _worth(self, used: FloatArray) -> FloatArray:
        """(2,) by how much what was found differs from `used`, where that is certain and enough; else 0 [s]."""
        settings, estimate = self._settings, self.found
        difference = estimate.value - used
        enough = np.maximum(settings.min_difference, 2 * estimate.deviation)
        sure = (estimate.deviation < settings.max_deviation) & (np.abs(difference) > enough)
        return np.where(sure, difference, 0.0)

    def advice(self) -> str:
        """Once for each channel: that the configured dead time looks wrong; empty if there is nothing to say."""
        # A second of changing motion: what was found at the first start is not worth a person's time.
        wrong = np.where(self._sums[0, 0] * self._dt > 1.0, self._worth(self._configured), 0.0)
        sentences = []
        for i in np.flatnonzero((np.abs(wrong) > self._settings.report_from) & ~self._told):
            self._told[i] = True
            longer = "longer" if wrong[i] > 0 else "shorter"
            sentences.append(
                f"dead time of {CHANNELS[i]} looks {1e3 * abs(wrong[i]):.0f} ms {longer} than configured, "
                f"{self.found.value[i]:.3f} s in all: change extra_dead_time.{CHANNELS[i]} by that"
            )
        return "; ".join(sentences)


def online_dead_time(config: ControllerConfig, model: VelocityModel | NonlinearModel) -> DeadTimeEstimator:
    """What learns the dead time of `model`.

    Raises
    ------
    ConfigError
        If there is none that could change.
    """
    if isinstance(model, NonlinearModel):
        raise ConfigError(
            f"online_dead_time.enabled = true: model '{model.name}' has its dead time in its window; set it to false"
        )
    if not config.compensation.dead_time:
        raise ConfigError("online_dead_time.enabled = true needs compensation.dead_time = true")
    return DeadTimeEstimator(config, model)


class OnlineDeadTimeFeature(Feature):
    """See `Feature`; raises ConfigError if there is no dead time that could change."""

    def __init__(self, config: ControllerConfig, model: VelocityModel | NonlinearModel) -> None:
        super().__init__(config, model)
        self._apply = config.online_dead_time.apply
        self._dead_time = online_dead_time(config, model)

    def longest(self) -> VelocityModel | None:
        """See `Feature`."""
        return self._dead_time.longest if self._apply else None

    def configure(self) -> None:
        """See `Feature`."""
        assert isinstance(self.host.model, VelocityModel)
        self._dead_time.used = self.host.model.dead_time

    def forget(self) -> None:
        """See `Feature`."""
        self._dead_time.forget()

    def set_applied(self, command: FloatArray) -> None:
        """See `Feature`."""
        self._dead_time.set_applied(command)

    def after_step(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Learn from the tick; where the dead time is another one, prepare to predict with it, a part at a tick."""
        words, dead_time = result.message, self._dead_time
        busy = self.host.is_preparing()
        if dead_time.take(t, measurement, result):
            wanted = None if busy else dead_time.wanted(t)
            if wanted is not None:
                self.host.change_dead_time(wanted)
            words = "; ".join(filter(None, (words, dead_time.advice(), dead_time.change(wanted))))
        return replace(result, message=words, dead_time=dead_time.found)


FEATURE = OnlineDeadTimeFeature
