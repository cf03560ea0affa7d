"""What a log tells about robot and configuration, in words, with the evidence; only where the data show it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.app.replay.open_loop import Replayed
from diffdrive_mpc.app.replay.recording import Recording
from diffdrive_mpc.app.replay.settings import ReplaySettings, replay_settings
from diffdrive_mpc.app.replay.statistics import SensorRow, at_limits, shares
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import BoolArray
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc.mpc.step_result import LearnedDeadTime

_UNITS = {"v": "m/s", "omega": "rad/s", "v_slew": "m/s^2", "omega_slew": "rad/s^2"}
_SAFE = ("BRAKING", "STOPPED", "REUSED_PLAN")
_NOISE = {
    "wheel_speed": "estimator.wheel_speed_noise",
    "wheel_yaw_rate": "estimator.wheel_yaw_rate_noise",
    "yaw_rate": "estimator.yaw_rate_noise",
    "pose": "estimator.position_noise and estimator.heading_noise, or what the poses state",
}


@dataclass(frozen=True)
class Diagnosis:
    """What was found, with its evidence, and what can be done."""

    what: str
    remedy: str


@dataclass(frozen=True)
class Evidence:
    """All that a verdict is made of.

    Attributes
    ----------
    recording, replayed
        The drive, and what the controller would have done.
    counted
        (n,) ticks that count.
    sensors
        A row for each.
    dead_time
        What was learned of it; None of a model that is not linear.
    """

    recording: Recording
    replayed: Replayed
    counted: BoolArray
    sensors: tuple[SensorRow, ...]
    dead_time: LearnedDeadTime | None


def verdicts(of: Evidence) -> tuple[Diagnosis, ...]:
    """All that can be said, the gravest first."""
    settings = replay_settings()
    rules = [_poses, _modes, _late, _accused, _dead_time, _limits, _yaw_gain, _offset, _innovations]
    return tuple(verdict for say in rules for verdict in say(of, settings))


def _poses(of: Evidence, _: ReplaySettings) -> Iterator[Diagnosis]:
    row = next(sensor for sensor in of.sensors if sensor.name == "poses")
    failure = of.replayed.config.failure
    if not row.readings:
        yield Diagnosis(
            "No pose is in the log: the controller would not drive at all.",
            "map the topic or columns of a localisation, or look at dead time, limits and speeds alone with "
            "--pose odometry",
        )
    elif row.longest_gap > failure.max_pose_age:
        longest = max(failure.max_pose_age, failure.dead_reckoning)
        yield Diagnosis(
            f"No pose came for {row.longest_gap:.2f} s from {row.gap_at:.2f} s on; the controller brakes after "
            f"{longest:g} s, failure.max_pose_age or with good wheels and gyro failure.dead_reckoning (usually a pose "
            f"comes every {row.interval:.3f} s).",
            "look at the localisation and its link at that time",
        )


def _modes(of: Evidence, _: ReplaySettings) -> Iterator[Diagnosis]:
    modes = shares(of.replayed.modes, of.counted)
    bad = {mode: share for mode, share in modes.items() if mode in _SAFE}
    if not bad:
        return
    counts = Counter(
        message
        for mode, message, keep in zip(of.replayed.modes, of.replayed.messages, of.counted, strict=True)
        if keep and mode in _SAFE and message
    )
    first = next(
        tick.time
        for tick, mode, keep in zip(of.recording.ticks, of.replayed.modes, of.counted, strict=True)
        if keep and mode in _SAFE
    )
    shown = ", ".join(f"{mode} at {share:.1f} % of the ticks" for mode, share in bad.items())
    why = f"; it says most often: “{counts.most_common(1)[0][0]}”" if counts else ""
    yield Diagnosis(
        f"The controller would not drive all the way: {shown}, first at {first:.2f} s{why}.",
        "docs/safety.md says what each message means; replay.csv has it tick by tick",
    )


def _late(of: Evidence, settings: ReplaySettings) -> Iterator[Diagnosis]:
    time, dt = of.recording.time, of.replayed.config.sample_time
    starts = np.array([tick.start is not None for tick in of.recording.ticks])[1:]
    gaps = np.where(starts | ~of.counted[1:], 0.0, np.diff(time))
    late = gaps > settings.late_tick * dt
    if late.any():
        worst = int(np.argmax(gaps))
        yield Diagnosis(
            f"{int(late.sum())} of {len(gaps) + 1} commands came late: the longest pause is {gaps[worst]:.3f} s at "
            f"{time[worst]:.2f} s; one is due every {dt:g} s.",
            "look at the load of the computer and at the priority of the process; the robot goes on with the last "
            "command meanwhile",
        )
    if (gaps < 0).any():
        yield Diagnosis(
            f"The clock went back at {time[int(np.argmin(gaps))]:.2f} s by {-gaps.min():.2f} s.",
            "synchronise clocks before the drive, not while driving",
        )


def _accused(of: Evidence, settings: ReplaySettings) -> Iterator[Diagnosis]:
    unused = shares([word or "-" for word in of.replayed.unused], of.counted)
    for sensors, share in unused.items():
        if sensors != "-" and share > settings.share_unused:
            yield Diagnosis(
                f"The other sensors contradict this one, so it is not used at {share:.1f} % of the ticks: {sensors}.",
                "check its mounting, its sign and its unit, and whether the floor let the wheels spin there",
            )


def _dead_time(of: Evidence, settings: ReplaySettings) -> Iterator[Diagnosis]:
    dead_time = of.dead_time
    if dead_time is None:
        return
    for i, name in enumerate(CHANNELS):
        value, deviation, used = float(dead_time.value[i]), float(dead_time.deviation[i]), float(dead_time.used[i])
        wrong = value - used
        # Less than half a sample, or than what is not known of it, changes nothing.
        least = max(settings.dead_time_wrong, 0.5 * of.replayed.config.sample_time, 2.0 * deviation)
        if not (deviation < settings.dead_time_deviation and abs(wrong) > least):
            continue
        word = "too short" if wrong > 0 else "too long"
        yield Diagnosis(
            f"The dead time of {name} is {word}: readings answer to commands after {value:.3f} s (±{deviation:.3f} s), "
            f"the controller counts on {used:.3f} s.",
            f"change extra_dead_time.{name} by {wrong:+.3f}, and replay again, unless the readings themselves come "
            "late by so much; identify tells the two apart where there are poses and a gyro",
        )


def _limits(of: Evidence, settings: ReplaySettings) -> Iterator[Diagnosis]:
    recorded, command, counted = of.recording.command, of.replayed.command, of.counted
    before = np.vstack([recorded[:1] * 0.0, recorded[:-1]])
    counted = counted & ~np.array([tick.start is not None for tick in of.recording.ticks])
    for whose, rows in (("recorded", recorded), ("replayed", command)):
        for limit, (at, over) in at_limits(rows[counted], before[counted], of.replayed).items():
            value = getattr(of.replayed.config.limits, limit)
            if whose == "recorded" and over > settings.share_at_limit:
                yield Diagnosis(
                    f"{over:.0f} % of the recorded commands are beyond limits.{limit} = {value:g} {_UNITS[limit]}: "
                    "whoever drove was not bound by it.",
                    f"raise limits.{limit} if the base can do that, or take this configuration's commands as the tamer",
                )
            elif whose == "replayed" and at > settings.share_at_limit:
                yield Diagnosis(
                    f"limits.{limit} = {value:g} {_UNITS[limit]} holds the controller back at {at:.0f} % of the ticks.",
                    f"ask for a slower path, or raise limits.{limit} if the base can do more",
                )


def _median(of: Evidence, column: int) -> tuple[float, FloatArray]:
    """Of the later half of what was believed of slip."""
    slip = of.replayed.slip[of.counted]
    slip = slip[np.isfinite(slip[:, column])]
    late = slip[len(slip) // 2 :, column]
    return (float(np.median(late)), late) if len(late) else (np.nan, late)


def _yaw_gain(of: Evidence, settings: ReplaySettings) -> Iterator[Diagnosis]:
    gain, late = _median(of, 1)
    if abs(gain - 1.0) > settings.yaw_gain_far:
        low, high = np.percentile(late, [5, 95])
        yield Diagnosis(
            f"The robot turns {gain:.2f} times as fast as the model says (5 to 95 % of the later half: {low:.2f} to "
            f"{high:.2f}).",
            "the estimator makes up for that while it drives; a model identified on this floor does from the start",
        )


def _offset(of: Evidence, settings: ReplaySettings) -> Iterator[Diagnosis]:
    offset, _ = _median(of, 0)
    if abs(offset) > settings.v_offset_far:
        yield Diagnosis(
            f"The robot drives {offset:+.3f} m/s faster than the model says.",
            "check wheels.radius and the gain of v; identify a model from this log",
        )


def _innovations(of: Evidence, settings: ReplaySettings) -> Iterator[Diagnosis]:
    for row in of.sensors:
        for sensor, count, mean in row.innovations:
            if count < settings.least_readings:
                continue
            noise = _NOISE[sensor]
            if mean > settings.innovations_large:
                yield Diagnosis(
                    f"{sensor.replace('_', ' ')}: readings differ from what was predicted by {np.sqrt(mean):.1f} times "
                    f"as much as the estimator assumes (median of {count}).",
                    f"raise {noise}; where dead time or model are wrong, mend these first",
                )
            elif mean < settings.innovations_small:
                yield Diagnosis(
                    f"{sensor.replace('_', ' ')}: readings differ from what was predicted by only {np.sqrt(mean):.2f} "
                    f"times as much as the estimator assumes (median of {count}): it trusts them too little.",
                    f"lower {noise}",
                )
