"""Check of a reference against model and limits before a drive, and search for a feasible timing.

A robot without limits follows a reference, apart from the smoothing by its lags. The check therefore computes only the
deviation from this ideal robot, by the steady-state twists of the commands. Commands that the limits reduce cause a
deficit of distance and heading, which later commands reduce as far as the limits permit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.two_sided import SlewLimit, TwoSided, sides_at
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.trajectories.limits import load_settings
from diffdrive_mpc.mpc.trajectories.speed_check import at_side, checked_reference

_LIMITS = ("v", "omega", "v_slew", "omega_slew", "wheel_speed", "predicted_v", "predicted_omega")
_ROUNDING = 1e-6
# Minimum step [s], and maximum number of steps; the rest of a reference is not checked.
_STEP, _MAX_TICKS = 0.05, 12_000
# Feedback gain that reduces the deficit [1/s], and share of a tolerance above which a deficit is recorded [-].
_DEFICIT_GAIN, _RECORD_SHARE = 5.0, 0.5
# Preview of v and omega, as shares of the horizon minus the lag [-]; the preview of omega is shorter, since the
# controller gives headings a low weight.
_PREVIEWS = 1.0, 0.5
# Candidate factors of the duration [-].
_STRETCHES = [1.1**step for step in range(1, 31)]
_Model = VelocityModel | NonlinearModel


@dataclass(frozen=True)
class Shortfall:
    """First point at which a reference exceeds the limits of the robot.

    Attributes
    ----------
    reference
        Name of the reference.
    time, arc_length
        Time of the reference [s] and distance along the reference [m] at which the violation starts.
    key
        Key of the violated limit, such as `limits.v.reverse` or `limits.omega_slew.brake`.
    needed, available
        Maximum value that the reference needs during the violation, and the limit [unit of the limit].
    behind
        Distance [m], or angle [rad] for limits of omega, by which a robot at the limit lags after the violation.
    duration, drivable
        Duration of the reference, and minimum feasible duration among the candidates [s]; infinite if none is feasible.
    start
        Speed of the reference when the first command takes effect on the robot at rest, if this is the violation
        [m/s, rad/s].
    """

    reference: str
    time: float
    arc_length: float
    key: str
    needed: float
    available: float
    behind: float
    duration: float
    drivable: float
    start: float = 0.0

    def __str__(self) -> str:
        """Format point, limit, consequence and remedy in one line."""
        name, unit = self.key.split(".")[1], "rad" if "omega" in self.key else "m"
        remedy = f"drive it in {self.drivable:.1f} s instead of {self.duration:.1f} s"
        if math.isinf(self.drivable):
            remedy = "no slower timing helps: raise the limit"
        if self.start:
            remedy = f"it is at {self.start:.2g} {unit}/s when the first command acts: start at rest or set start_delay"
        return (
            f"reference '{self.reference}': infeasible from {self.time:.2f} s ({self.arc_length:.2f} m): {name} takes "
            f"{self.needed:.3g} {unit}/s{'^2' if 'slew' in name else ''}, {self.key} = {self.available:.3g}; "
            f"it falls {self.behind:.2f} {unit} behind; {remedy}"
        )


def find_shortfall(
    reference: Reference, config: ControllerConfig, model: _Model, *, is_moving: bool = False
) -> Shortfall | None:
    """Find the first point where `reference` exceeds the limits of `config` with `model`; None if it is feasible.

    The robot starts on the reference, either at rest or, if `is_moving` is True, with the reference's twist. Steps and
    corners that the lags smooth do not count as violations. The tolerances are in `settings.yaml`. Only the first ten
    minutes of a reference are checked.
    """
    make_ticks = partial(_Ticks, checked_reference(reference), config, model, is_moving)
    ticks = make_ticks(1.0)
    records = ticks.deficit()
    if records is None:
        return None
    first, end = int(records[0, 0]), int(records[-1, 0]) + ticks.preview + 1
    # Sum of the reductions of each kind, relative to the tolerance of the channel.
    parts = (np.abs(records[:, 1:]) / np.tile(ticks.tolerance, 3)).sum(axis=0)
    exceeded = ticks.ratio > 1.0 + _ROUNDING
    # A limit that only the feedback exceeds, and not the reference, is not the cause.
    row = int(np.argmax(np.where(exceeded[:end].any(axis=0), [*parts[:4], parts[4:].max(), *parts[4:]], -1.0)))
    over, name = np.flatnonzero(exceeded[:, row]), _LIMITS[row]
    span = [span for span in np.split(over, np.flatnonzero(np.diff(over) > 1) + 1) if span[0] < end][-1]
    needed, ratio = ticks.needed[span, row], ticks.ratio[span, row]
    loss = 0.5 * ticks.step * (ratio - 1.0).sum() if "slew" in name else 1.0 - 1.0 / ratio
    limit = getattr(config.limits, name)
    size, bound, side = at_side(needed[np.argmax(ratio)], limit if isinstance(limit, TwoSided) else TwoSided(limit))
    starts_at_speed = first == 0 and "slew" in name and not is_moving
    time = min(first * ticks.step + float(ticks.lag[int("omega" in name)]), reference.duration)
    return Shortfall(
        reference.name,
        time,
        float(reference.sample([time]).arc_length[0]),
        f"limits.{name}{side}",
        size,
        bound,
        float(ticks.step * (np.abs(needed) * loss).sum()),
        reference.duration,
        reference.duration * next((factor for factor in _STRETCHES if make_ticks(factor).deficit() is None), math.inf),
        abs(float(ticks.body[0, int("omega" in name)])) if starts_at_speed else 0.0,
    )


class _Ticks:
    """Simulation of a drive within the limits, along a reference that is slowed down by the factor `stretch`."""

    def __init__(
        self, reference: Reference, config: ControllerConfig, model: _Model, is_moving: bool, stretch: float
    ) -> None:
        settings, limits = load_settings(), config.limits
        self.config, self.gain, self.lag = config, np.asarray(model.dc_gain), np.maximum(model.lag, 0.0)
        self.tolerance = np.array([settings.tolerance, settings.heading_tolerance])
        self.step = step = max(config.sample_time, _STEP)
        end = reference.duration * stretch + config.finish.timeout
        times = np.arange(0.0, np.fmin(end, _MAX_TICKS * step) + step, step)
        body = [reference.sample((times + delay) / stretch).twist[:, row] for row, delay in enumerate(self.lag)]
        self.body = np.stack(body, axis=-1) / stretch
        # The reference moves before the first command takes effect, so the robot starts with a deficit.
        lead = reference.sample([0.0, self.lag[0] / stretch]).arc_length
        self.lead = 0.0 if is_moving else float(np.copysign(lead[1] - lead[0], self.body[0, 0]))
        # This lead hides a shorter deficit at the start, which the robot removes together with it.
        self.start = 0.0 if is_moving else 2.0 * float(self.lag[0])
        command = np.linalg.solve(self.gain, self.body.T).T
        self.previous_command = previous = np.vstack([is_moving * command[:1], command[:-1]])
        # The sign selects the side of the slew limit: negative while the magnitude of the command decreases.
        change = np.abs(command - previous) / step * np.where(np.abs(command) >= np.abs(previous), 1.0, -1.0)
        wheels = np.abs(self.body) @ [1.0, 0.5 * config.wheels.track]
        self.needed = np.column_stack([command, change, wheels, self.body])
        bounds = [sides_at(getattr(limits, name), self.needed[:, row]) for row, name in enumerate(_LIMITS)]
        self.ratio = np.abs(self.needed) / np.stack(bounds, axis=-1)
        self.preview = int(max(config.horizon * config.sample_time - float(self.lag.max()), 0.0) / step)
        ranges, slews = (limits.v, limits.omega), (limits.v_slew, limits.omega_slew)
        clipped = np.clip(command, [-limit.sides[1] for limit in ranges], [limit.sides[0] for limit in ranges])
        ahead = [int(share * self.preview) for share in _PREVIEWS]
        self.command = np.stack([_preview(clipped[:, row], slews[row], step, ahead[row]) for row in (0, 1)], axis=-1)

    def deficit(self) -> FloatArray | None:
        """Simulate the drive until the deficit exceeds a tolerance.

        Returns
        -------
        FloatArray or None
            (ticks, 7) records from the start of the deficit to the violation of the tolerance: tick number, and
            reductions of v and omega by the range, by the slew, and by the limits of the twist. None if no tolerance is
            violated.
        """
        if (self.ratio <= 1.0 + _ROUNDING).all():
            return None
        limits, h, gain = self.config.limits, self.step, _DEFICIT_GAIN
        tolerance, turn_tolerance = self.tolerance.tolist()
        (v_up, v_down), (w_up, w_down) = limits.v.sides, limits.omega.sides
        v_rise, v_fall, w_rise, w_fall = (h * rate for rate in (*limits.v_slew.sides, *limits.omega_slew.sides))
        wheel_speed, max_v, max_w = float(limits.wheel_speed), limits.predicted_v, limits.predicted_omega
        half_track = 0.5 * self.config.wheels.track
        (g00, g01), (g10, g11) = self.gain.tolist()
        # Pose of the reference in the frame of the robot. The lead at the start is not caused by limits: `free_x` is
        # its value in a drive without limits, and is subtracted below.
        x = free_x = self.lead
        y, turn, v_ref, w_ref = (0.0, 0.0, *map(float, self.previous_command[0]))
        records: list[tuple[float, ...]] = []
        for tick, (v, w, v_plan, w_plan) in enumerate(np.column_stack([self.body, self.command]).tolist()):
            # The lateral error is critically damped at 1 m/s.
            v_target, w_target = v_plan + gain * x, w_plan + gain * (turn + 0.25 * gain * v * y)
            v_in, w_in = min(max(v_target, -v_down), v_up), min(max(w_target, -w_down), w_up)
            v_ref, w_ref = _slew(v_ref, v_in, v_rise, v_fall), _slew(w_ref, w_in, w_rise, w_fall)
            v_body, w_body = g00 * v_ref + g01 * w_ref, g10 * v_ref + g11 * w_ref
            wheels = (abs(v_body) + half_track * abs(w_body)) / wheel_speed
            over = max(wheels, abs(v_body) / max_v, abs(w_body) / max_w, 1.0)
            v_out, w_out = v_body / over, w_body / over
            cuts = v_target - v_in, w_target - w_in, v_in - v_ref, w_in - w_ref, v_body - v_out, w_body - w_out
            records.append((tick, *cuts))
            x, y = x + h * (w_out * y - v_out + v * math.cos(turn)), y + h * (v * math.sin(turn) - w_out * x)
            turn += h * (w - w_out)
            free_x *= 1.0 - gain * h
            size = max(math.hypot(x - free_x, y) / tolerance, abs(turn) / turn_tolerance)
            if size > 1.0 and tick * h >= self.start:
                return np.array(records)
            # The deficit has not started yet, or the feedback has removed it.
            if size < _RECORD_SHARE:
                records.clear()
        return None


def _preview(clipped: FloatArray, slew: SlewLimit, step: float, preview: int) -> FloatArray:
    """Return commands (K,) that anticipate changes above the slew limit, so that the ramp is centred on the change.

    The ramp starts before the change by half of its additional time. Its slope before the change is the harmonic mean
    of the slew limit and of the slope of the change.
    """
    change, bounds = np.diff(clipped, prepend=0.0) / step, []
    for sense in (1.0, -1.0):
        rate = np.where(sense * clipped >= 0.0, slew.sides[1], slew.sides[0])
        slope = 2.0 * step / (1.0 / rate + 1.0 / np.where(-sense * change > rate, -sense * change, np.inf))
        bound = sense * clipped
        for ahead in range(1, min(preview, len(clipped) - 1) + 1):
            bound[:-ahead] = np.minimum(bound[:-ahead], sense * clipped[ahead:] + ahead * slope[ahead:])
        bounds.append(sense * bound)
    high, low = bounds
    return np.asarray(np.where(high < clipped, high, low))


def _slew(last: float, command: float, rise: float, fall: float) -> float:
    """Compute one channel of `models.two_sided.reached`; in a loop, floats are ten times faster than arrays."""
    low, high = last - (fall if last > 0.0 else rise), last + (fall if last < 0.0 else rise)
    if last > 0.0 > low:
        low *= rise / fall
    if last < 0.0 < high:
        high *= rise / fall
    return min(max(command, low), high)
