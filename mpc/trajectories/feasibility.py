"""Find where a reference asks for more than model and limits give, before the robot moves, and which timing would do.

The linear model without limits follows a reference up to what its lags round off. So only the difference to that robot
is computed, in the twists that commands settle at: commands that the limits cut leave a deficit of distance and
heading, which later commands work off as far as the limits allow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
    """Where a reference first asks for more than the robot has.

    Attributes
    ----------
    reference
        Name of the reference.
    time, arc_length
        Where it begins: time of the reference [s], distance along it [m].
    key
        Limit that is reached, such as `limits.v.reverse` or `limits.omega_slew.brake`.
    asked, available
        Largest value that the reference asks for there, and the limit [unit of the limit].
    behind, late
        Largest distance behind the schedule [m], and how late the reference ends [s].
    duration, drivable
        Duration of the reference, and the one at which this function finds no shortfall [s]; infinite if none does.
    """

    reference: str
    time: float
    arc_length: float
    key: str
    asked: float
    available: float
    behind: float
    late: float
    duration: float
    drivable: float

    def __str__(self) -> str:
        """Place, limit, consequence and remedy in one line."""
        asks, unit = _KINDS[self.key.split(".")[1]]
        remedy = (
            f"drive it in {self.drivable:.1f} s instead of {self.duration:.1f} s (timing: smooth)"
            if math.isfinite(self.drivable)
            else "no slower timing helps: raise the limit"
        )
        return (
            f"reference '{self.reference}': infeasible from {self.time:.2f} s ({self.arc_length:.2f} m): {asks} "
            f"{self.asked:.3g} {unit}, {self.key} = {self.available:g}; up to {self.behind:.2f} m behind, ends "
            f"{self.late:.1f} s late; {remedy}"
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
    begin, row = ticks.cause(drive)
    name = list(_KINDS)[row]
    limit, signed = getattr(config.limits, name), ticks.signed[begin:, row]
    # Of the stretch that asks for too much, from where the command is first cut.
    beyond = ticks.ratio[begin:, row] > 1.0 + _ROUNDING
    first = int(np.argmax(beyond))
    end = first + int(np.argmin(np.append(beyond[first:], False)))
    worst = first + int(np.argmax(ticks.ratio[begin + first : begin + max(end, first + 1), row]))
    sided = isinstance(limit, TwoSided) and not limit.is_symmetric
    time = min(begin * ticks.step + ticks.lag[row % 2], reference.duration)
    return Shortfall(
        reference.name,
        time,
        float(reference.sample([time]).arc_length[0]),
        f"limits.{name}" + (f".{limit.names[bool(signed[worst] < 0.0)]}" if sided else ""),
        abs(float(signed[worst])),
        side_of(limit, signed[worst]),
        drive.behind,
        drive.late,
        reference.duration,
        reference.duration * _stretch(reference, config, model),
    )


def _stretch(reference: Reference, config: ControllerConfig, model: VelocityModel | NonlinearModel) -> float:
    """Return the factor on the duration at which the reference is feasible; infinite if none up to the most is."""
    settings, low, high = load_settings(), 1.0, 1.0
    while _Ticks(reference, config, model, high).drive(whole=False):
        if high >= settings.max_stretch:
            return math.inf
        low, high = high, 1.5 * high
    while high > (1.0 + settings.stretch_step) * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if _Ticks(reference, config, model, middle).drive(whole=False) else (low, middle)
    return high


@dataclass(frozen=True)
class _Drive:
    """Drive beyond the tolerance: distance behind [m], lateness at the end [s], and cuts by limit while it falls behind.

    `cuts` (ticks, 7) are in units of the tolerances per second, of the limits in `_KINDS`; `places` (ticks,) are the
    ticks of the reference.
    """

    behind: float
    late: float
    places: FloatArray
    cuts: FloatArray


class _Ticks:
    """Commands that a reference asks for, `stretch` times as slow, and the drive that the limits allow."""

    def __init__(
        self, reference: Reference, config: ControllerConfig, model: VelocityModel | NonlinearModel, stretch: float
    ) -> None:
        settings, limits = load_settings(), config.limits
        self.config, self.gain, self.lag = config, np.asarray(model.dc_gain), np.maximum(model.lag, 0.0)
        self.step = step = max(config.sample_time, settings.feasibility_step)
        times = np.arange(int(min(reference.duration * stretch / step, settings.max_ticks)) + 2) * step
        ahead = [reference.sample((times + delay) / stretch).twist[:, row] for row, delay in enumerate(self.lag)]
        self.body = np.stack(ahead, axis=-1) / stretch
        # Until the first command shows, the reference gets ahead of the robot at rest.
        start = reference.sample([0.0, *(self.lag / stretch)])
        self.start = float(np.copysign(start.arc_length[1], self.body[0, 0])), float(start.pose[2, 2] - start.pose[0, 2])
        asked = np.linalg.solve(self.gain, self.body.T).T
        before = np.vstack([np.zeros((1, 2)), asked[:-1]])
        change = np.abs(asked - before) / step * np.where(np.abs(asked) >= np.abs(before), 1.0, -1.0)
        wheels = np.abs(self.body) @ [1.0, 0.5 * config.wheels.track]
        self.signed = np.column_stack([asked, change, wheels, self.body])
        bounds = [sides_at(getattr(limits, name), self.signed[:, row]) for row, name in enumerate(_KINDS)]
        self.ratio = np.abs(self.signed) / np.stack(bounds, axis=-1)
        preview = max(config.horizon * config.sample_time - float(self.lag.max()), 0.0)
        self.command = np.stack(
            [
                _foreseen(np.clip(column, -limit.sides[1], limit.sides[0]), slew, step, int(preview / step))
                for column, limit, slew in zip(
                    asked.T, (limits.v, limits.omega), (limits.v_slew, limits.omega_slew), strict=True
                )
            ],
            axis=-1,
        )

    def drive(self, *, whole: bool = True) -> _Drive | None:
        """Drive the reference; return how that goes if it exceeds the tolerance, at once unless the `whole` counts."""
        if (self.ratio <= 1.0 + _ROUNDING).all():
            return None
        config, settings, h = self.config, load_settings(), self.step
        wait, turn_wait, fastest = config.reentry.wait, config.reentry.heading_wait, config.reentry.max_progress
        limits, half_track = config.limits, 0.5 * config.wheels.track
        (v_up, v_down), (w_up, w_down) = limits.v.sides, limits.omega.sides
        (v_grows, v_falls), (w_grows, w_falls) = ((s.sides[0] * h, s.sides[1] * h) for s in (limits.v_slew, limits.omega_slew))
        (g00, g01), (g10, g11) = self.gain.tolist()
        (i00, i01), (i10, i11) = np.linalg.inv(self.gain).tolist()
        rows = np.column_stack([self.body, self.command]).tolist()
        along_gain, turn_gain, across_gain = settings.catch_up, settings.catch_up_heading, settings.catch_up_across
        tolerance, turn_tolerance = settings.tolerance, settings.heading_tolerance
        (x, turn), y = self.start, 0.0
        free_x, free_turn = self.start
        v_ref = w_ref = place = behind = 0.0
        grows, exceeds, last, ticks = 0, 0, len(rows) - 1, []
        while place < last and len(ticks) < 4 * last + 100:
            ahead = len(ticks) - place
            v, w, v_wanted, w_wanted = rows[int(place)]
            rate = min(fastest if ahead > 1.0 else 1.0, max(0.0, 2.0 - max(math.copysign(x, x * v) / wait, abs(turn) / turn_wait)))
            v_body, w_body = along_gain * x, turn_gain * turn + across_gain * v * y
            v_wanted = v_wanted * rate + i00 * v_body + i01 * w_body
            w_wanted = w_wanted * rate + i10 * v_body + i11 * w_body
            v_in, w_in = min(max(v_wanted, -v_down), v_up), min(max(w_wanted, -w_down), w_up)
            v_ref, w_ref = _reached(v_ref, v_in, v_grows, v_falls), _reached(w_ref, w_in, w_grows, w_falls)
            v_body, w_body = g00 * v_ref + g01 * w_ref, g10 * v_ref + g11 * w_ref
            wheels = (abs(v_body) + half_track * abs(w_body)) / limits.wheel_speed
            over = max(1.0, wheels, abs(v_body) / limits.predicted_v, abs(w_body) / limits.predicted_omega)
            ticks.append((place, v_wanted - v_in, w_wanted - w_in, v_in - v_ref, w_in - w_ref, v_body, w_body, over, wheels))
            v_body, w_body = v_body / over, w_body / over
            x, y, turn = (
                x + h * (w_body * y - v_body + v * rate * math.cos(turn)),
                y + h * (v * rate * math.sin(turn) - w_body * x),
                turn + h * (w * rate - w_body),
            )
            # Part of the deficit is time for which the reference has waited.
            free_x, free_turn = free_x * (1.0 - along_gain * h), free_turn * (1.0 - turn_gain * h)
            gap, angle = x - free_x + h * ahead * v, turn - free_turn + h * ahead * w
            behind = max(behind, abs(gap))
            size = max(math.hypot(gap, y) / tolerance, abs(angle) / turn_tolerance)
            if not exceeds:
                if size < settings.grows_from:
                    grows = len(ticks)
                if size > 1.0:
                    exceeds = len(ticks)
                    if not whole:
                        break
            place += rate
        if not exceeds:
            return None
        return _Drive(behind, h * (len(ticks) - last), *self._cuts(np.array(ticks[min(grows, exceeds - 1) : exceeds])))

    def _cuts(self, ticks: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return places and cuts of `_Drive` from what `drive` noted (ticks, 9)."""
        settings = load_settings()
        unit = np.array([settings.tolerance, settings.heading_tolerance])
        body, over, wheels = np.abs(ticks[:, 5:7]) / unit, ticks[:, 7], ticks[:, 8]
        lost = body * (1.0 - 1.0 / over)[:, None]
        by_wheels = (wheels >= over) & (over > 1.0)
        lost_else = np.where(by_wheels[:, None], 0.0, lost)
        cuts = np.abs(ticks[:, 1:5]) / np.tile(unit, 2)
        return ticks[:, 0], np.column_stack([cuts, np.where(by_wheels, lost.max(axis=1), 0.0), lost_else])

    def cause(self, drive: _Drive) -> tuple[int, int]:
        """Return the tick from which a drive falls behind, and the row of the limit that causes most of it."""
        row = int(np.argmax(drive.cuts.sum(axis=0)))
        return int(drive.places[0]), row


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
