"""Count unsafe commands of a run, from the outside.

It shares no code with the controller: limits come from plain YAML, the rules from docs/safety.md, and nothing but
NumPy and a YAML parser is imported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

STATED = Path(__file__).with_name("stated_limits.yaml")
"""Limits where a configuration sets none."""

# Sums in floating point: a limit is kept to this [m/s, rad/s].
_ROUNDING = 1e-9
_BRAKES = ("BRAKING", "FINISHED")
_DRIVES = ("TRACKING", "REUSED_PLAN")
_STANDS = "STOPPED"


@dataclass(frozen=True)
class StatedLimits:
    """Limits that the controller promises; pairs are v [m/s, m/s^2] and omega [rad/s, rad/s^2].

    `most`: largest command forward and to the left; `slew`: largest rate of growth while driving; `braking`: rate to
    zero; `max_pose_age`: without a pose for longer it brakes [s]; `sample_time`: between two ticks [s]; `least_radius`:
    of a command's turn, 0 where there is none [m]; `behind`: largest command in reverse and to the right, and `falls`:
    largest rate of fall while driving; None: as `most` and `slew`.
    """

    most: tuple[float, float]
    slew: tuple[float, float]
    braking: tuple[float, float]
    max_pose_age: float
    sample_time: float
    least_radius: float = 0.0
    behind: tuple[float, float] | None = None
    falls: tuple[float, float] | None = None


@dataclass(frozen=True)
class Unsafe:
    """Number of ticks of a run at which the command violated a limit.

    Attributes
    ----------
    not_finite
        It was not two finite numbers.
    limit
        It was beyond the largest command.
    slew
        It changed by more in a tick than its mode allows: the slew limit in TRACKING and REUSED_PLAN; in BRAKING and
        FINISHED the braking limit, towards zero only; in STOPPED any change, but the command must be zero.
    motion
        It asked for more motion than a ramp at the braking limits that begins when no pose has come for `max_pose_age`,
        or for any before the first pose.
    turn
        It turned tighter than the least radius, where there is one; while it brakes only a radius counts that a ramp at
        the braking limits keeps.
    """

    not_finite: int
    limit: int
    slew: int
    motion: int
    turn: int = 0

    @property
    def total(self) -> int:
        """All of them; a tick that broke two counts twice."""
        return self.not_finite + self.limit + self.slew + self.motion + self.turn


def stated_limits(config: str | Path | None, overrides: Mapping[str, object]) -> StatedLimits:
    """Read the limits in plain YAML: the stated limits, then a configuration file, then values by dotted key.

    Raises KeyError or TypeError where a number is missing, OSError where a file is.
    """
    values = _plain(_flat(yaml.safe_load(STATED.read_text(encoding="utf-8"))))
    if config is not None:
        values |= _plain(_flat(yaml.safe_load(Path(config).read_text(encoding="utf-8"))))
    values |= _plain(_flat(overrides))

    def pair(ending: str, v_side: str = "", omega_side: str = "") -> tuple[float, float]:
        keys = (f"limits.v{ending}", f"limits.omega{ending}")
        v, omega = (values.get(f"{key}.{name}") for key, name in zip(keys, (v_side, omega_side or v_side), strict=True))
        return float(values[keys[0]] if v is None else v), float(values[keys[1]] if omega is None else omega)

    return StatedLimits(
        pair("", "forward", "left"),
        pair("_slew", "accelerate"),
        pair("_braking"),
        max(float(values["failure.max_pose_age"]), float(values.get("failure.dead_reckoning") or 0.0)),
        float(values["sample_time"]),
        float(values.get("limits.min_commanded_radius") or 0.0),
        pair("", "reverse", "right"),
        pair("_slew", "brake"),
    )


def check_commands(
    time: ArrayLike, command: ArrayLike, modes: Sequence[str], pose_came: ArrayLike, limits: StatedLimits
) -> Unsafe:
    """Count the unsafe commands in a run of n ticks, which began with a robot at rest.

    Parameters
    ----------
    time
        (n,) instants [s].
    command
        (n, 2) v [m/s], omega [rad/s].
    modes
        (n,) mode that the controller reported; an unknown word has no limit.
    pose_came
        (n,) whether a finite pose was delivered at the tick.
    limits
        Limits of the robot.
    """
    times, commands = np.asarray(time, dtype=float), np.asarray(command, dtype=float)
    finite = np.isfinite(commands).all(axis=1)
    # A command that is not finite is counted once; for the ticks around it the command counts as zero.
    sound = np.where(finite[:, None], commands, 0.0)
    before = np.vstack([np.zeros(2), sound[:-1]])
    most = np.where(sound < 0.0, limits.behind or limits.most, limits.most)
    beyond = (np.abs(sound) > most + _ROUNDING).any(axis=1)
    steps = [_keeps_step(modes[k], before[k], sound[k], limits) for k in range(len(times))]
    blind = _moves_blind(times, sound, np.asarray(pose_came, dtype=bool), limits)
    return Unsafe(
        int(np.count_nonzero(~finite)),
        int(np.count_nonzero(finite & beyond)),
        int(np.count_nonzero(finite & ~np.array(steps, dtype=bool))),
        int(np.count_nonzero(finite & blind)),
        int(np.count_nonzero(finite & _turns_tighter(sound, modes, limits))),
    )


def _keeps_step(mode: str, last: NDArray[np.float64], now: NDArray[np.float64], limits: StatedLimits) -> bool:
    if mode == _STANDS:
        return bool((now == 0.0).all())
    if mode not in (*_BRAKES, *_DRIVES):
        return False
    grows, falls = np.array(limits.slew), np.array(limits.falls or limits.slew)
    if mode in _BRAKES:
        grows = falls = np.array(limits.braking)
    # Time that it takes: a fall towards zero, then growth from there.
    along, size = np.where(last < 0.0, -now, now), np.abs(last)
    taken = np.maximum(along - size, 0.0) / grows + np.clip(size - along, 0.0, size) / falls
    taken += np.maximum(-along, 0.0) / grows
    within = bool((taken <= limits.sample_time + _ROUNDING / np.minimum(grows, falls)).all())
    # While braking, a command never grows and never changes sign.
    slower = (now * last >= -_ROUNDING).all() and (np.abs(now) <= np.abs(last) + _ROUNDING).all()
    return within and (mode in _DRIVES or bool(slower))


def _turns_tighter(commands: NDArray[np.float64], modes: Sequence[str], limits: StatedLimits) -> NDArray[np.bool_]:
    """Return (n,) True for a command that turns more tightly than allowed."""
    v, omega = np.abs(commands).T
    tighter = omega * limits.least_radius > v + _ROUNDING
    while_braking = limits.least_radius * limits.braking[1] >= limits.braking[0]
    return np.asarray(tighter & (while_braking | ~np.isin(modes, _BRAKES)))


def _moves_blind(
    times: NDArray[np.float64], commands: NDArray[np.float64], pose_came: NDArray[np.bool_], limits: StatedLimits
) -> NDArray[np.bool_]:
    """Return (n,) True for a command above the ramp that starts when poses have been missing for too long."""
    blind = np.zeros(len(times), dtype=bool)
    last_pose, ramp = -np.inf, np.zeros(2)
    # A tick may come just before the age is reached, and the ramp begins with the one after it.
    patience = limits.max_pose_age + limits.sample_time
    for k, time in enumerate(times):
        if pose_came[k]:
            last_pose = time
        if time - last_pose <= patience + _ROUNDING:
            ramp = np.abs(commands[k])
            continue
        ramp = np.maximum(ramp - np.array(limits.braking) * limits.sample_time, 0.0)
        blind[k] = bool((np.abs(commands[k]) > ramp + _ROUNDING).any())
    return blind


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Remove the prefix "expert." from keys, and translate the former name of the radius."""
    plain = {key.removeprefix("expert."): value for key, value in values.items()}
    former = "limits.least_commanded_radius"
    return {"limits.min_commanded_radius" if key == former else key: value for key, value in plain.items()}


def _flat(data: Any, prefix: str = "") -> dict[str, Any]:  # noqa: ANN401 - plain YAML
    flat: dict[str, Any] = {}
    for key, value in (data or {}).items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat
