"""Find where a reference asks for more than model and limits give, before the robot moves, and which timing would do.

The linear model without limits follows a reference up to what its lags round off. So only the difference to that robot
is computed, in the twists that commands settle at: commands that the limits cut leave a deficit of distance and
heading, which later commands work off as far as the limits allow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.two_sided import SlewLimit, TwoSided, side_of, sides_at
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.trajectories.limits import load_settings

_KINDS = {
    "v": ("v_ref is", "m/s"),
    "omega": ("omega_ref is", "rad/s"),
    "v_slew": ("v_ref changes by", "m/s^2"),
    "omega_slew": ("omega_ref changes by", "rad/s^2"),
    "wheel_speed": ("a wheel turns at", "m/s"),
    "predicted_v": ("v is", "m/s"),
    "predicted_omega": ("omega is", "rad/s"),
}
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Shortfall:
    """First place at which a reference asks for more than the robot has.

    Attributes
    ----------
    reference
        Name of the reference.
    time, arc_length
        Where it begins: time of the reference [s], distance along it [m].
    key
        Limit that is reached, such as `limits.v.reverse` or `limits.omega_slew.brake`.
    needed, available
        Largest value that the reference needs there, and the limit [unit of the limit].
    behind
        Largest distance behind the schedule if the reference waits for the robot, roughly [m].
    duration, drivable
        Duration of the reference, and the one at which this function finds no shortfall [s]; infinite if none does.
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

    def __str__(self) -> str:
        """Place, limit, consequence and remedy in one line."""
        needs, unit = _KINDS[self.key.split(".")[1]]
        remedy = (
            f"drive it in {self.drivable:.1f} s instead of {self.duration:.1f} s"
            if math.isfinite(self.drivable)
            else "no slower timing helps: raise the limit"
        )
        return (
            f"reference '{self.reference}': infeasible from {self.time:.2f} s ({self.arc_length:.2f} m): {needs} "
            f"{self.needed:.3g} {unit}, {self.key} = {self.available:.3g}; falls about {self.behind:.2f} m "
            f"behind; {remedy}"
        )


def find_shortfall(
    reference: Reference, config: ControllerConfig, model: VelocityModel | NonlinearModel
) -> Shortfall | None:
    """Return where `reference` first takes the robot of `config` and `model` beyond its limits; None if nowhere.

    The robot starts at rest on the reference. Steps and corners that lags round off do not count. Tolerances are in
    `settings.yaml`. Of a longer reference the first `max_ticks` are looked at.
    """
    ticks = _Ticks(reference, config, model, 1.0)
    drive = ticks.drive()
    if drive is None:
        return None
    first, end = int(drive.notes[0, 0]), int(drive.notes[-1, 0]) + ticks.preview + 1
    ratio, cuts = ticks.ratio[first:end], ticks.cuts(drive.notes)
    # A limit that only the way back to the reference meets is no cause.
    blamed = cuts * (ratio.max(axis=0) > 1.0 + _ROUNDING)
    row = int(np.argmax(blamed if blamed.any() else cuts))
    name, worst = list(_KINDS)[row], float(ticks.needed[first + int(np.argmax(ratio[:, row])), row])
    limit = getattr(config.limits, name)
    is_sided = isinstance(limit, TwoSided) and not limit.is_symmetric
    time = min(first * ticks.step + float(ticks.lag[row % 2]), reference.duration)
    return Shortfall(
        reference.name,
        time,
        float(reference.sample([time]).arc_length[0]),
        f"limits.{name}" + (f".{limit.names[worst < 0.0]}" if is_sided else ""),
        abs(worst),
        side_of(limit, worst),
        drive.behind,
        reference.duration,
        reference.duration * _stretch(reference, config, model),
    )


def _stretch(reference: Reference, config: ControllerConfig, model: VelocityModel | NonlinearModel) -> float:
    """Return the factor on the duration at which the reference is feasible; infinite if none up to the most is."""

    def fails(stretch: float) -> bool:
        return _Ticks(reference, config, model, stretch).drive(whole=False) is not None

    settings, low, high = load_settings(), 1.0, 1.5
    while fails(high):
        if high >= settings.max_stretch:
            return math.inf
        low, high = high, 1.5 * high
    while high > (1.0 + settings.stretch_step) * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if fails(middle) else (low, middle)
    return high


class _Drive(NamedTuple):
    """Drive that exceeds the tolerance: largest distance behind the schedule [m], and why it falls behind.

    `notes` (ticks, 9) are from where the deficit grows to where it is too large: tick of the reference, by how much v
    and omega are cut to their range, then to their slew, twist, its wheel speed over the limit, and what is largest of
    that and of twist over its limits.
    """

    behind: float
    notes: FloatArray


class _Ticks:
    """Commands that a reference asks for, `stretch` times as slow, and the drive that the limits allow."""

    def __init__(
        self, reference: Reference, config: ControllerConfig, model: VelocityModel | NonlinearModel, stretch: float
    ) -> None:
        settings, limits = load_settings(), config.limits
        self.config, self.gain, self.lag = config, np.asarray(model.dc_gain), np.maximum(model.lag, 0.0)
        self.step = step = max(config.sample_time, settings.feasibility_step)
        duration = reference.duration * stretch + config.finish.timeout
        times = np.arange(int(min(duration / step, settings.max_ticks)) + 2) * step
        ahead = [reference.sample((times + delay) / stretch).twist[:, row] for row, delay in enumerate(self.lag)]
        self.body = np.stack(ahead, axis=-1) / stretch
        # Until the first command shows, the reference gets ahead of the robot at rest.
        start = reference.sample([0.0, *(self.lag / stretch)])
        turned = float(start.pose[2, 2] - start.pose[0, 2])
        self.start = float(np.copysign(start.arc_length[1] - start.arc_length[0], self.body[0, 0])), turned
        command = np.linalg.solve(self.gain, self.body.T).T
        before = np.vstack([np.zeros((1, 2)), command[:-1]])
        change = np.abs(command - before) / step * np.where(np.abs(command) >= np.abs(before), 1.0, -1.0)
        wheels = np.abs(self.body) @ [1.0, 0.5 * config.wheels.track]
        self.needed = np.column_stack([command, change, wheels, self.body])
        bounds = [sides_at(getattr(limits, name), self.needed[:, row]) for row, name in enumerate(_KINDS)]
        self.ratio = np.abs(self.needed) / np.stack(bounds, axis=-1)
        self.preview = int(max(config.horizon * config.sample_time - float(self.lag.max()), 0.0) / step)
        ranges, slews = (limits.v, limits.omega), (limits.v_slew, limits.omega_slew)
        cut = np.clip(command, [-limit.sides[1] for limit in ranges], [limit.sides[0] for limit in ranges])
        previews = self.preview, int(settings.yaw_preview * self.preview)
        foreseen = [_foreseen(cut[:, row], slews[row], step, previews[row]) for row in (0, 1)]
        self.command = np.stack(foreseen, axis=-1)

    def drive(self, *, whole: bool = True) -> _Drive | None:
        """Return the drive if it exceeds the tolerance, only its first part unless the `whole` counts; else None."""
        if (self.ratio <= 1.0 + _ROUNDING).all():
            return None
        settings, reentry, limits, h = load_settings(), self.config.reentry, self.config.limits, self.step
        wait, turn_wait, fastest = reentry.wait, reentry.heading_wait, reentry.max_progress
        (v_up, v_down), (w_up, w_down) = limits.v.sides, limits.omega.sides
        v_grows, v_falls, w_grows, w_falls = (h * rate for rate in (*limits.v_slew.sides, *limits.omega_slew.sides))
        v_ends, w_ends = 2.0 * limits.v_slew.sides[1], 2.0 * limits.omega_slew.sides[1] / settings.catch_up_heading
        wheel_speed, top_v, top_w = float(limits.wheel_speed), limits.predicted_v, limits.predicted_omega
        half_track = 0.5 * self.config.wheels.track
        (g00, g01), (g10, g11) = self.gain.tolist()
        (i00, i01), (i10, i11) = np.linalg.inv(self.gain).tolist()
        rows = np.column_stack([self.body, self.command]).tolist()
        length = (h * np.cumsum(np.abs(self.body[:, 0]))).tolist()
        along_gain, turn_gain, across_gain = settings.catch_up, settings.catch_up_heading, settings.catch_up_across
        tolerance, turn_tolerance, grows_from = settings.tolerance, settings.heading_tolerance, settings.grows_from
        most_across = 2.0 - settings.least_progress
        (x, turn), y = self.start, 0.0
        free_x, free_turn = self.start
        v_ref = w_ref = place = behind = 0.0
        tick, exceeds, last, notes = 0, False, len(rows) - 1, []
        while place < last and tick < 2 * last:
            v, w, v_wanted, w_wanted = rows[int(place)]
            # Only a robot that moves gets back to its path.
            late = max((x if v >= 0.0 else -x) / wait, min(abs(y) / wait, most_across))
            turned = abs(turn) / turn_wait
            rate = min(fastest if tick - place > 1.0 else 1.0, max(0.0, 2.0 - (late if late > turned else turned)))
            v_body, w_body = along_gain * x, turn_gain * turn + across_gain * v * y
            # No faster than the slew can end it in time.
            v_body = math.copysign(min(abs(v_body), math.sqrt(v_ends * abs(x))), v_body)
            w_body = math.copysign(min(abs(w_body), math.sqrt(w_ends * abs(w_body))), w_body)
            v_wanted = v_wanted * rate + i00 * v_body + i01 * w_body
            w_wanted = w_wanted * rate + i10 * v_body + i11 * w_body
            v_in, w_in = min(max(v_wanted, -v_down), v_up), min(max(w_wanted, -w_down), w_up)
            v_ref, w_ref = _reached(v_ref, v_in, v_grows, v_falls), _reached(w_ref, w_in, w_grows, w_falls)
            v_body, w_body = g00 * v_ref + g01 * w_ref, g10 * v_ref + g11 * w_ref
            wheels = (abs(v_body) + half_track * abs(w_body)) / wheel_speed
            over = max(wheels, abs(v_body) / top_v, abs(w_body) / top_w, 1.0)
            if not exceeds:
                cuts = v_wanted - v_in, w_wanted - w_in, v_in - v_ref, w_in - w_ref
                notes.append((place, *cuts, v_body, w_body, wheels, over))
            v_body, w_body, v, w = v_body / over, w_body / over, v * rate, w * rate
            x, y, turn = (
                x + h * (w_body * y - v_body + v * math.cos(turn)),
                y + h * (v * math.sin(turn) - w_body * x),
                turn + h * (w - w_body),
            )
            free_x, free_turn = free_x * (1.0 - along_gain * h), free_turn * (1.0 - turn_gain * h)
            tick, place = tick + 1, place + rate
            # Time for which the reference has waited is part of the deficit.
            waited = h * (tick - place)
            gap, angle = x - free_x + waited * v, turn - free_turn + waited * w
            behind = max(behind, length[min(tick, last)] - length[min(int(place), last)] + abs(x))
            if not exceeds:
                size = max(math.hypot(gap, y) / tolerance, abs(angle) / turn_tolerance)
                if size > 1.0:
                    exceeds = True
                    if not whole:
                        break
                elif size < grows_from:
                    notes.clear()
        return _Drive(behind, np.array(notes)) if exceeds else None

    @staticmethod
    def cuts(notes: FloatArray) -> FloatArray:
        """Return the part of each limit (7,) in a deficit from the notes of a drive, in units of the tolerances."""
        settings = load_settings()
        unit = np.array([settings.tolerance, settings.heading_tolerance])
        twist, wheels, over = np.abs(notes[:, 5:7]) / unit, notes[:, 7], notes[:, 8]
        lost = twist * (1.0 - 1.0 / over)[:, None]
        by_wheels = wheels >= over
        parts = [np.abs(notes[:, 1:5]) / np.tile(unit, 2), lost.max(axis=1) * by_wheels, lost * ~by_wheels[:, None]]
        return np.asarray(np.column_stack(parts).sum(axis=0))


def _foreseen(cut: FloatArray, slew: SlewLimit, step: float, preview: int) -> FloatArray:
    """Return commands (K,) that begin to change so early that a change beyond the slew lies in the middle of its ramp.

    Half of the time by which the ramp takes longer is before it: that is a slope of the harmonic mean of both.
    """
    change, bounds = np.diff(cut, prepend=0.0) / step, []
    for sense in (1.0, -1.0):
        rate = np.where(sense * cut >= 0.0, slew.sides[1], slew.sides[0])
        slope = 2.0 * step / (1.0 / rate + 1.0 / np.where(-sense * change > rate, -sense * change, np.inf))
        bound = sense * cut
        for ahead in range(1, min(preview, len(cut) - 1) + 1):
            bound[:-ahead] = np.minimum(bound[:-ahead], sense * cut[ahead:] + ahead * slope[ahead:])
        bounds.append(sense * bound)
    high, low = bounds
    return np.asarray(np.where(high < cut, high, low))


def _reached(last: float, command: float, grows: float, falls: float) -> float:
    """Return one channel of `models.two_sided.reached` as a plain number, which a loop takes ten times as fast."""
    low, high = last - (falls if last > 0.0 else grows), last + (falls if last < 0.0 else grows)
    if last > 0.0 > low:
        low *= grows / falls
    if last < 0.0 < high:
        high *= grows / falls
    return min(max(command, low), high)
