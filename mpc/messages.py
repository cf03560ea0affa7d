"""Message texts for codes of the C core: modes, solver statuses, and reasons for actions and rejections."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.core.tick import Tick
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.solver.report import SolverMethod, SolverStatus
from diffdrive_mpc.mpc.step_result import Mode

_TOLERANCE = 0.1
"""Relative deviation of a sensor's motion from that of the poses up to which no fault is assumed [-]."""
_MIN_COURSE_ANGLE = 15.0
"""Angle between course and heading above which side-slip is not the cause [deg]."""
_MIN_RATIO = 0.35
"""Ratio of wheel distance to pose distance above which the signs of the wheels can be determined [-]."""
_SCALES = {"yaw rate": "sensors.yaw_rate.scale (57.3 for degrees)", "wheel speed": "sensors.wheels.scale"}
"""Configuration key that corrects a wrong unit, by sensor."""


class MessageFormatter:
    """Formatter of the messages in a controller's results.

    Attributes
    ----------
    modes, statuses
        Modes and solver statuses by C code.
    not_a_new_tick
        Bits of the reasons for which a call of `step` is not a new tick.
    """

    def __init__(self, tick: Tick, config: ControllerConfig) -> None:
        lib = tick.lib
        self._result, self._lib = tick.result, lib
        self.modes = {getattr(lib, f"DDMPC_{mode.name}"): mode for mode in Mode}
        self.statuses = {
            getattr(lib, f"DDMPC_QP_{status.name}"): status for status in SolverStatus if status.name != "REFUSED"
        }
        self._subjects = {
            lib.DDMPC_OF_WHEELS: "wheel speed",
            lib.DDMPC_OF_YAW_RATE: "yaw rate",
            lib.DDMPC_OF_POSE: "pose",
        }
        # In the order of ddmpc_subject.
        self._excluded = {
            lib.DDMPC_WHEELS_EXCLUDED: "wheel speed",
            lib.DDMPC_YAW_RATE_EXCLUDED: "yaw rate",
            lib.DDMPC_POSE_EXCLUDED: "pose",
        }
        self.not_a_new_tick: int = (
            lib.DDMPC_TIME_FAULTY | lib.DDMPC_TIME_REPEATED | lib.DDMPC_TIME_LEAPT | lib.DDMPC_TIME_PAUSED
        )
        self.cause = ""
        """Reason for the failure after which the robot waits for `start` or `resume`; empty if the robot can drive."""
        self.configure(config)

    def configure(self, config: ControllerConfig) -> None:
        """Use the limits and solver name of `config` in later messages."""
        self._config = config
        self._methods: dict[int, str] = {
            self._lib.DDMPC_NO_METHOD: SolverMethod.NONE,
            self._lib.DDMPC_UNLIMITED: SolverMethod.UNLIMITED,
            self._lib.DDMPC_ACTIVE_SET: SolverMethod.ACTIVE_SET,
            self._lib.DDMPC_BACKEND: config.solver.backend,
        }

    def method(self, number: int) -> str:
        """Return the name of the solver method with the C code `number`."""
        return self._methods[number]

    def sentence(self, hold: Hold | None, status: SolverStatus, target: str) -> str:
        """Return the message of the last tick; `target` is its part about the tracked target."""
        c, lib = self._result, self._lib
        reasons = c.reasons
        parts = [describe(c) for bit, describe in self._time_messages() if reasons & bit]
        if reasons & lib.DDMPC_SENT_REJECTED:
            parts.append("sent command rejected: it is not two finite numbers, or exceeds the command limits")
        parts += [self._note(c.note[index]) for index in range(c.notes)]
        parts += self._sensor_messages(c)
        if reasons & lib.DDMPC_HELD and hold is not None:
            parts.append(hold.reason)
        parts += [text for bit, text in self._failure_messages(lib, c) if reasons & bit]
        if target:
            parts.append(target)
        if reasons & lib.DDMPC_SOLVE_FAILED:
            parts.append(f"solve failed: {status}")
        if reasons & lib.DDMPC_LATCHED:
            cause = f" ({self.cause})" if self.cause else ""
            # Only the parts at the first tick of the stop are certain to name the failure.
            self.cause = self.cause or "; ".join(parts)
            parts.append(f"stopped after a failure{cause}; call start or resume to drive on")
        # A repeated tick has no other reason, so the stop may continue.
        elif not reasons & lib.DDMPC_TIME_REPEATED:
            self.cause = ""
        return "; ".join(parts)

    def _time_messages(self) -> list[tuple[int, Callable[[Any], str]]]:
        lib, dt = self._lib, self._config.sample_time

        def describe_leap(c: Any) -> str:  # noqa: ANN401 - cffi has no types
            is_in_ms = abs(c.gap / dt - 1000.0) < 100.0
            return f"no tick for {c.gap:.2f} s" + (
                ", 1000 sample times: give step its t in seconds" if is_in_ms else ""
            )

        return [
            (lib.DDMPC_TIME_FAULTY, _describe_invalid_time),
            (
                lib.DDMPC_TIME_REPEATED,
                lambda c: f"called {1e3 * c.gap:.1f} ms after the last tick; its command is repeated",
            ),
            (lib.DDMPC_TIME_LEAPT, describe_leap),
            (lib.DDMPC_TIME_PAUSED, lambda c: f"no tick for {c.gap:.2f} s; the estimate restarts"),
        ]

    def _failure_messages(self, lib: Any, c: Any) -> list[tuple[int, str]]:  # noqa: ANN401
        failure, finish, fence = self._config.failure, self._config.finish, self._config.fence
        age = c.estimate.pose_age[0]
        return [
            (lib.DDMPC_NO_POSE, "no pose has arrived yet"),
            (lib.DDMPC_ELSEWHERE, "consecutive poses agree on a different position"),
            (lib.DDMPC_LOST, "the estimate is not finite; it restarts"),
            (lib.DDMPC_OLD_POSE, f"no pose was accepted for {age:.2f} s"),
            (
                lib.DDMPC_TOO_FAR,
                f"{c.distance:.2f} m from the reference; the limit is {failure.max_position_error} m",
            ),
            (
                lib.DDMPC_LEFT_FENCE,
                f"the stopping path leaves the fence of {fence.length:g} by {fence.width:g} m; call start or reset to "
                "drive on",
            ),
            (
                lib.DDMPC_TURN_HELD,
                "the turn radius is limited to limits.min_commanded_radius = "
                f"{self._config.limits.min_commanded_radius} m",
            ),
            (
                lib.DDMPC_DEADLINES_MISSED,
                f"solves missed their deadline at {c.solver.missed} ticks in a row; the limit is solver.max_missed = "
                f"{self._config.solver.max_missed}: shorten the horizon, or raise solver.time_limit",
            ),
            (
                lib.DDMPC_NOT_AT_REST,
                f"finished {c.distance:.3f} m from the end, not at rest within {finish.timeout} s",
            ),
        ]

    def unused(self, reasons: int) -> tuple[str, ...]:
        """Return the names of the sensors that are not used because the other sensors contradict them."""
        return tuple(name for bit, name in self._excluded.items() if reasons & bit)

    def _sensor_messages(self, c: Any) -> list[str]:  # noqa: ANN401
        """Return messages about the sensor comparison: unused sensors, and faults with remedies."""
        lib, messages = self._lib, []
        for subject, (bit, name) in enumerate(self._excluded.items()):
            if c.reasons & bit:
                is_repeating = c.repeating >> subject & 1
                cause = "its readings repeat, and " if is_repeating else ""
                is_impossible = bool(c.implausible >> subject & 1)
                error = "" if is_repeating else _describe_mounting_error(name, c, is_impossible=is_impossible)
                messages.append(f"{name} not used: {cause}the other sensors contradict it{error}")
        if c.reasons & lib.DDMPC_POSES_SCATTER:
            messages.append(f"poses scatter {c.pose_scatter:.1f} times as far as their covariance states")
        if c.reasons & lib.DDMPC_POSES_LATE:
            messages.append(f"poses are about {c.pose_delay:.2f} s later than their stamps")
        if c.reasons & lib.DDMPC_POSES_RARE:
            failure = self._config.failure
            messages.append(
                f"poses come every {c.pose_interval:.2f} s and {c.pose_latency:.2f} s late, too rarely for "
                f"failure.max_pose_age of {failure.max_pose_age:g} s: the robot stays braked; raise it above "
                f"{c.pose_interval + c.pose_latency:.2f} s, or send poses more often or sooner"
            )
        if c.reasons & lib.DDMPC_POSES_TOO_OLD:
            messages.append(
                f"poses come {c.pose_latency:.2f} s late, and the history reaches back "
                f"{self._config.estimator.history:g} s: raise estimator.history, or send poses sooner"
            )
        if c.reasons & lib.DDMPC_TURNS_OTHERWISE:
            wheels, body = c.turn_ratio
            messages.append(
                f"wheels turn the robot {wheels:.2f} times as far as commanded, and its body turns {body:.2f} times as "
                "far as the wheels: slip, weak motors, or wrong wheels.track and wheels.encoder_track"
            )
        return messages

    def _note(self, note: Any) -> str:  # noqa: ANN401
        lib, a, b = self._lib, note.a, note.b
        pose, wheels = note.subject == lib.DDMPC_OF_POSE, note.subject == lib.DDMPC_OF_WHEELS
        not_numbers = "it is not three finite numbers" if pose else "not 2 finite numbers" if wheels else "not finite"
        reasons = {
            lib.DDMPC_NOT_NUMBERS: not_numbers,
            lib.DDMPC_BAD_COVARIANCE: "its covariance is not a valid " + ("3 x 3 matrix" if pose else "covariance"),
            lib.DDMPC_BAD_STAMP: "its stamp is not a finite number",
            lib.DDMPC_IN_FUTURE: f"its stamp lies {a:.3f} s in the future",
            lib.DDMPC_NOT_NEWER: "its stamp is not newer than the previous one",
            lib.DDMPC_TOO_OLD: f"it is {a:.2f} s old; the history reaches back {self._config.estimator.history} s",
            lib.DDMPC_TOO_LARGE: f"{a:.3g} is more than {b:g}",
            lib.DDMPC_JUMPS: f"it jumps by {a:.2f} m and {b:.2f} rad" if pose else f"it jumps from {a:.2f} to {b:.2f}",
            lib.DDMPC_TOO_MANY: "too many arrived for one sample: send fewer",
        }
        return f"{self._subjects[note.subject]} rejected: {reasons[note.fault]}"


def _describe_mounting_error(name: str, c: Any, *, is_impossible: bool) -> str:  # noqa: ANN401
    """Return the probable mounting or scaling error of a sensor, with a remedy; empty if no error is found."""
    turn, distance, wheel_turn = (float(ratio) for ratio in c.reads)
    angle = math.degrees(c.direction)
    if is_impossible:
        return f"; many readings exceed the possible motion of the robot: correct its unit, or set {_SCALES[name]}"
    if name == "yaw rate" and turn and abs(turn) < _TOLERANCE:
        return "; it measures no turn while poses turn: correct its axis, or its unit"
    if name == "yaw rate" and turn and abs(turn - 1) > _TOLERANCE:
        remedies = ["sensors.yaw_rate.sign: -1"] if turn < -_TOLERANCE else []
        if abs(abs(turn) - 1) > _TOLERANCE:
            remedies.append(f"sensors.yaw_rate.scale: {abs(turn):.2f}")
        return f"; it turns {turn:.2f} times as far as poses: set {' and '.join(remedies)}, or correct its axis"
    if name == "wheel speed" and (abs(distance - 1) > _TOLERANCE or wheel_turn < 0):
        signs = {"sign": distance, "turn_sign": wheel_turn}
        sign_settings = " and ".join(f"sensors.wheels.{key}: -1" for key, ratio in signs.items() if ratio < 0)
        sign_remedy = "swap the sides, or correct the signs"
        if sign_settings and min(abs(distance), abs(wheel_turn)) > _MIN_RATIO:
            sign_remedy += f", or set {sign_settings}"
        is_scale = abs(wheel_turn - distance) < _MIN_RATIO * abs(distance)
        scale = f", or set sensors.wheels.scale: {distance:.2f}" if is_scale else " of each side"
        remedy = sign_remedy if sign_settings or distance < _MIN_RATIO else f"correct ticks and radius{scale}"
        return f"; wheels drive {distance:.2f} and turn {wheel_turn:.2f} times as far as poses: {remedy}"
    if name == "pose" and abs(angle) > _MIN_COURSE_ANGLE:
        heading = f"set sensors.pose.heading: {-c.direction:.2f} if the angle is the same everywhere"
        return f"; their course differs from their heading by {angle:.0f} deg: {heading}, or mirror their frame"
    return ""


def _describe_invalid_time(c: Any) -> str:  # noqa: ANN401
    if c.gap < 0:
        return f"time ran backwards by {-c.gap:.3f} s; call start again if the clock was set"
    return f"the time of this tick is {c.gap}; it was not used"
