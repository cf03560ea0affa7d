"""Count the unsafe commands of a run, independently of the controller.

The module shares no code with the controller: the limits come from plain YAML, the rules from docs/safety.md, and the
only imports are NumPy and a YAML parser.
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
"""File of the default limits."""

# Tolerance of a limit for rounding errors [m/s, rad/s].
_ROUNDING = 1e-9
_BRAKING = ("BRAKING", "FINISHED")
_DRIVING = ("TRACKING", "REUSED_PLAN")
_STOPPED = "STOPPED"


@dataclass(frozen=True)
class StatedLimits:
    """Limits that the commands must keep; pairs are v [m/s, m/s^2] and omega [rad/s, rad/s^2].

    Attributes
    ----------
    maximum
        Maximum command forwards and to the left.
    slew
        Maximum rate of increase while driving.
    braking
        Maximum rate of decrease while braking.
    max_pose_age
        Time without a pose after which the controller must brake [s].
    sample_time
        Duration of a tick [s].
    min_radius
        Minimum radius of a commanded turn [m]; 0 for no limit.
    reverse_maximum
        Maximum command backwards and to the right; None: as `maximum`.
    slew_down
        Maximum rate of decrease while driving; None: as `slew`.
    """

    maximum: tuple[float, float]
    slew: tuple[float, float]
    braking: tuple[float, float]
    max_pose_age: float
    sample_time: float
    min_radius: float = 0.0
    reverse_maximum: tuple[float, float] | None = None
    slew_down: tuple[float, float] | None = None


@dataclass(frozen=True)
class Unsafe:
    """Number of ticks of a run at which the command violated a limit.

    Attributes
    ----------
    not_finite
        A value is not finite.
    limit
        The command exceeds its maximum.
    slew
        The change since the last tick exceeds the limit of the mode: the slew limit in TRACKING and REUSED_PLAN; the
        braking limit, towards zero only, in BRAKING and FINISHED. In STOPPED the command must be zero.
    motion
        The command exceeds a braking ramp that starts after `max_pose_age` without a pose, or it is not zero before the
        first pose.
    turn
        The radius of the turn is less than the minimum radius. While braking, this counts only if a ramp at the
        braking limits can keep the radius.
    """

    not_finite: int
    limit: int
    slew: int
    motion: int
    turn: int = 0

    @property
    def total(self) -> int:
        """Total number of violations; a tick that violates two limits counts twice."""
        return self.not_finite + self.limit + self.slew + self.motion + self.turn


def stated_limits(config: str | Path | None, overrides: Mapping[str, object]) -> StatedLimits:
    """Read the limits in plain YAML: the stated limits, then a configuration file, then values by dotted key.

    Raises KeyError or TypeError if a number is missing, OSError if a file is missing.
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
    time: ArrayLike, command: ArrayLike, modes: Sequence[str], has_pose: ArrayLike, limits: StatedLimits
) -> Unsafe:
    """Count the unsafe commands in a run of n ticks that starts at rest.

    Parameters
    ----------
    time
        (n,) times [s].
    command
        (n, 2) commands v [m/s], omega [rad/s].
    modes
        (n,) modes reported by the controller; an unknown mode counts as a violation.
    has_pose
        (n,) True if the tick had a finite pose.
    limits
        Limits of the robot.
    """
    times, commands = np.asarray(time, dtype=float), np.asarray(command, dtype=float)
    finite = np.isfinite(commands).all(axis=1)
    # A nonfinite command is counted once, and replaced by zero in the other checks.
    finite_commands = np.where(finite[:, None], commands, 0.0)
    previous = np.vstack([np.zeros(2), finite_commands[:-1]])
    maximum = np.where(finite_commands < 0.0, limits.reverse_maximum or limits.maximum, limits.maximum)
    exceeds = (np.abs(finite_commands) > maximum + _ROUNDING).any(axis=1)
    is_step_allowed = [_is_step_allowed(modes[k], previous[k], finite_commands[k], limits) for k in range(len(times))]
    blind = _moves_without_pose(times, finite_commands, np.asarray(has_pose, dtype=bool), limits)
    return Unsafe(
        int(np.count_nonzero(~finite)),
        int(np.count_nonzero(finite & exceeds)),
        int(np.count_nonzero(finite & ~np.array(is_step_allowed, dtype=bool))),
        int(np.count_nonzero(finite & blind)),
        int(np.count_nonzero(finite & _violates_radius(finite_commands, modes, limits))),
    )


def _is_step_allowed(mode: str, last: NDArray[np.float64], now: NDArray[np.float64], limits: StatedLimits) -> bool:
    if mode == _STOPPED:
        return bool((now == 0.0).all())
    if mode not in (*_BRAKING, *_DRIVING):
        return False
    up, down = np.array(limits.slew), np.array(limits.slew_down or limits.slew)
    if mode in _BRAKING:
        up = down = np.array(limits.braking)
    # Time of the change: a decrease to zero, then an increase.
    signed_size, size = np.where(last < 0.0, -now, now), np.abs(last)
    duration = np.maximum(signed_size - size, 0.0) / up + np.clip(size - signed_size, 0.0, size) / down
    duration += np.maximum(-signed_size, 0.0) / up
    within = bool((duration <= limits.sample_time + _ROUNDING / np.minimum(up, down)).all())
    # While braking, a command must neither increase nor change sign.
    decreases = (now * last >= -_ROUNDING).all() and (np.abs(now) <= np.abs(last) + _ROUNDING).all()
    return within and (mode in _DRIVING or bool(decreases))


def _violates_radius(commands: NDArray[np.float64], modes: Sequence[str], limits: StatedLimits) -> NDArray[np.bool_]:
    """Return (n,) True for each command whose radius is below the minimum."""
    v, omega = np.abs(commands).T
    is_tighter = omega * limits.min_radius > v + _ROUNDING
    while_braking = limits.min_radius * limits.braking[1] >= limits.braking[0]
    return np.asarray(is_tighter & (while_braking | ~np.isin(modes, _BRAKING)))


def _moves_without_pose(
    times: NDArray[np.float64], commands: NDArray[np.float64], has_pose: NDArray[np.bool_], limits: StatedLimits
) -> NDArray[np.bool_]:
    """Return (n,) True for each command above the braking ramp that starts after `max_pose_age` without a pose."""
    blind = np.zeros(len(times), dtype=bool)
    last_pose, ramp = -np.inf, np.zeros(2)
    # The age can be reached just after a tick, and the ramp then starts at the next tick.
    tolerance = limits.max_pose_age + limits.sample_time
    for k, time in enumerate(times):
        if has_pose[k]:
            last_pose = time
        if time - last_pose <= tolerance + _ROUNDING:
            ramp = np.abs(commands[k])
            continue
        ramp = np.maximum(ramp - np.array(limits.braking) * limits.sample_time, 0.0)
        blind[k] = bool((np.abs(commands[k]) > ramp + _ROUNDING).any())
    return blind


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Remove the prefix "expert." from keys."""
    return {key.removeprefix("expert."): value for key, value in values.items()}


def _flat(data: Any, prefix: str = "") -> dict[str, Any]:  # noqa: ANN401 - plain YAML
    flat: dict[str, Any] = {}
    for key, value in (data or {}).items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat
