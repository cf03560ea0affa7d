"""Free space of one controller: half-spaces for the plan, and a check of the stopping path after each solve."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.core_sources import Tick
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.mpc.config.fixed_values import STANDING
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.step_result import Mode, StepResult
from diffdrive_mpc_extras.free_space.config import free_space_of
from diffdrive_mpc_extras.free_space.crossing import Crossing, crossing
from diffdrive_mpc_extras.free_space.guide import BentReference, Guide, PathTable
from diffdrive_mpc_extras.free_space.pieces import (
    PARAMETERS,
    PieceCache,
    Pieces,
    PlacedFootprint,
    address,
    build_pieces,
    load_free_space,
    min_gaps,
)
from diffdrive_mpc_extras.free_space.polygons import Footprint
from diffdrive_mpc_extras.free_space.surroundings import Surroundings

AT_REST = 0.02
"""Speed below which a contact is harmless and not checked [m/s]."""
# Distance beyond the margin up to which an obstacle gets a half-space [m]; a plan may deviate this far in a horizon.
_NEAR = 0.5
# The gap to an obstacle inside the margin may shrink by _PLAY [m], but not below _MIN_RATIO of the margin.
_PLAY, _MIN_RATIO = 0.004, 0.5
# Time after the last command within which every robot comes to rest [s].
_STOP_TIME = 0.6
# Maximum number of braking samples that are checked; braking from the limits of the command is always checked whole.
_MAX_RAMP = 1000
# Speed up to which a disc counts as standing [m/s]; the robot drives around a standing disc and does not wait for it.
_STANDING_SPEED = 0.05
# Period of the path search [ticks], and its period after a change of the surroundings.
_SEARCH_PERIOD, _SHORT_PERIOD = 5, 3
# Distance to the end of the path at which the robot stops [m].
_END_DISTANCE = 0.03
# Distance to a plane up to which its constraint counts as active [m].
_ACTIVE_WITHIN = 0.002


class FreeSpaceKeeper:
    """Surroundings of one controller, their constraints on its plan, and the checks of its commands.

    Parameters
    ----------
    config
        Configuration with `free_space.enabled`.
    tick
        Tick of the controller.
    first
        Index of the parameters of the first half-space among the parameters of all terms.
    """

    def __init__(self, config: ControllerConfig, tick: Tick, first: int) -> None:
        self._tick, self._first = tick, first
        ffi, self._lib = load_free_space()
        settings = free_space_of(config)
        self._footprint = PlacedFootprint(Footprint(settings.corners, settings.footprint_radius))
        self._pieces: Pieces | None = None
        self._cache: PieceCache = {}
        self._surroundings: Surroundings | None = None
        self._reference: Reference | None = None
        self._guide: Guide | None = None
        self._closed_by = "something"
        self._crossing: Crossing | None = None
        self._standing: Pieces | None = None
        self._moving: Pieces | None = None
        self._ticks_since_search, self._is_new = _SEARCH_PERIOD, False
        self.pace = math.inf
        """Maximum progress rate of the reference in this tick [-]."""
        stages = config.horizon + 1
        self._table = np.zeros((stages, settings.rows * PARAMETERS))
        self._owner = np.full((stages, settings.rows), -1, dtype=np.intc)
        self._spread = np.zeros((stages, 9))
        self._stages: FloatArray = np.asarray(np.arange(stages) * config.sample_time)
        self._keeping = ffi.new("ddmpc_keeping *")
        self._planning = ffi.new("ddmpc_keeping *")
        self.configure(config)
        self._last: StepResult | None = None
        self._braked = False
        self._clear_rows()

    def configure(self, config: ControllerConfig) -> None:
        """Apply a configuration with other limits."""
        self._config, self._settings = config, free_space_of(config)
        settings = self._settings
        for keeping, margin in (
            (self._keeping, settings.margin),
            (self._planning, settings.margin + settings.reserve),
        ):
            keeping.margin, keeping.factor, keeping.doubt = margin, settings.uncertainty_factor, settings.disc_doubt
            keeping.moving = settings.moving_margin
            keeping.reach, keeping.scale = margin + settings.moving_margin + _NEAR, settings.strictness

    def set_obstacles(self, surroundings: Surroundings | None) -> None:
        """Replace the surroundings from the next step on; None removes all.

        Raises
        ------
        SurroundingsError
            If an object is invalid; the previous surroundings then stay in effect.
        """
        pieces = (
            None if surroundings is None else build_pieces(surroundings, self._settings, self._reference, self._cache)
        )
        self._take(surroundings, pieces)
        if pieces is None:
            self._clear_rows()

    def _take(self, surroundings: Surroundings | None, pieces: Pieces | None) -> None:
        self._surroundings, self._pieces, self._is_new = surroundings, pieces, True
        self._standing = self._moving = None
        if pieces is not None:
            stands = np.hypot(pieces.velocity[:, 0], pieces.velocity[:, 1]) <= _STANDING_SPEED
            self._standing = pieces if stands.all() else pieces.select(stands)
            self._moving = None if stands.all() else pieces.select(~stands)

    def start(self, reference: Reference) -> Reference:
        """Start a reference, and return it with the offsets that lead around obstacles."""
        self._reference, self._last = reference, None
        table = PathTable.build(reference)
        self._guide = Guide(table, self._footprint, self._settings)
        self._ticks_since_search, self.pace, self._crossing = _SEARCH_PERIOD, math.inf, None
        if self._surroundings is not None and self._surroundings.corridor is not None:
            self._take(self._surroundings, build_pieces(self._surroundings, self._settings, reference, self._cache))
        return BentReference(reference, self._guide)

    def forget(self) -> None:
        """Reset."""
        self._last = None

    def before(self, t: float, time: float, tracked: Reference) -> Hold | None:
        """Prepare the tick at `t` [s]: return a reason to stop, or set half-spaces for the plan and the progress rate.

        `time` [s] is the approximate present time of the reference. `tracked` is the motion to track: the reference,
        or the path back to it.
        """
        self.pace = math.inf
        if self._pieces is None or self._guide is None:
            return None
        stale = self._stale_reason(t)
        if stale:
            return Hold(stale)
        reason = self._plan_path(t, time)
        if reason:
            return Hold(reason)
        self._set_rows(t, tracked.sample(time + self._stages).pose)
        return None

    def _plan_path(self, t: float, time: float) -> str:
        """Search a path and set the progress rate of the reference; return the reason to stop, empty for none."""
        guide, reference = self._guide, self._reference
        assert guide is not None and reference is not None and self._standing is not None
        sample = reference.sample([time])
        arc, speed = float(sample.arc_length[0]), abs(float(sample.twist[0, 0]))
        last = self._last
        v = 0.0 if last is None or last.estimate is None else float(last.estimate.twist[0])
        self._ticks_since_search += 1
        if self._ticks_since_search >= (_SHORT_PERIOD if self._is_new else _SEARCH_PERIOD):
            self._ticks_since_search, self._is_new = 0, False
            guide.update(
                arc, v, self._standing, (self._required_gap(), _MIN_RATIO * self._settings.margin), self._path_limits()
            )
            # The name is stored because the surroundings may change until the next search.
            self._closed_by = self._standing.names[guide.blocked_by] if guide.blocked_by >= 0 else "something"
        self._crossing = None
        if self._moving is not None:
            required_gap = self._planning.margin + self._settings.moving_margin
            self._crossing = crossing(
                guide, self._footprint, self._moving, self._settings, (arc, abs(v), speed), self._age(t), required_gap
            )
            reason = self._standing_wait(t)
            if reason:
                self.pace = 0.0
                return reason
        end = min(guide.ends, self._crossing.ends if self._crossing else math.inf)
        limit = guide.speed_now(arc, end)
        if math.isfinite(limit):
            stretch = float(np.hypot(1.0, guide.slope[guide.node(arc)]))
            self.pace = limit / max(speed * stretch, STANDING)
        if end - arc > _END_DISTANCE:
            return ""
        self.pace = 0.0
        return self._block_reason()

    def _standing_wait(self, t: float) -> str:
        """Return the reason to wait if the robot stands next to a moving object, else an empty string."""
        last = self._last
        if last is None or last.estimate is None or self._moving is None:
            return ""
        v, omega = last.estimate.twist.tolist()
        if abs(v) + abs(omega) * self._footprint.footprint.reach > 2.0 * AT_REST:
            return ""
        now = np.array([self._age(t)])
        required_gap = self._required_gap() + self._settings.moving_margin
        (gap,), (piece,) = min_gaps(self._footprint, self._moving, last.estimate.pose[None], now, required_gap)
        return f"waits for {self._moving.names[piece]}, which is {max(gap, 0.0):.2f} m away" if piece >= 0 else ""

    def _block_reason(self) -> str:
        """Return the reason why the path ends."""
        assert self._guide is not None
        crossing, end = self._crossing, self._guide.ends
        if crossing is not None and crossing.ends <= end and self._moving is not None:
            return f"waits for {self._moving.names[crossing.piece]}, which crosses the path"
        return f"no way: blocked by {self._closed_by}; waits until the surroundings or the path change"

    def _required_gap(self) -> float:
        """Return the gap that a path needs [m]: the margin of the plan plus the uncertainty of the present position."""
        spread = self._spread[0]
        return float(self._planning.margin + self._planning.factor * math.sqrt(max(spread[0], spread[4], 0.0)))

    def _path_limits(self) -> tuple[float, float, float]:
        """Return maximum yaw rate [rad/s], lateral acceleration [m/s^2] and speed [m/s] of a path."""
        config = self._config
        effort = config.reentry.effort
        return effort * config.limits.omega, load_robot().reference_acceleration.lateral, config.limits.v

    def after(self, t: float, result: StepResult, sent: FloatArray) -> StepResult:
        """Check the stopping path after the command of the tick, and brake if it comes too close to an obstacle.

        `sent` (2,) is the command of the previous tick.
        """
        self._last, self._braked = result, False
        if self._pieces is None or result.estimate is None or self._surroundings is None:
            return result
        settings = self._settings
        self._predict_covariances(result)
        driving = result.mode in (Mode.TRACKING, Mode.REUSED_PLAN)
        poses, twists = self._stopping_path(result.command)
        contact = self._sweep(t, poses, twists)
        clearance, ahead = self._clearances(t, poses[:1], result.plan)
        ahead = min(ahead, contact.min_gap if contact.min_gap < self._keeping.reach else math.inf)
        result = replace(
            result, clearance=clearance, clearance_ahead=ahead, pressed_by=self._active_obstacles(result.plan)
        )
        if contact.sample < 0 or not driving:
            return result
        command = self._ramp(sent)
        self._tick.set_applied_commands(command[None])
        message = (
            f"braking: the stopping path comes within {max(contact.gap, 0.0):.2f} m of "
            f"{self._pieces.names[contact.piece]}; free_space.margin is {settings.margin:g} m"
        )
        self._braked, at_rest = True, not command.any()
        self._last = replace(
            result,
            command=command,
            mode=Mode.STOPPED if at_rest else Mode.BRAKING,
            message="; ".join(filter(None, (result.message, message))),
            _planned=None,
        )
        return self._last

    def again(self, result: StepResult) -> StepResult:
        """Return the result of a repeated call, with the braking command if the tick braked."""
        last = self._last
        if last is None or not self._braked or result.mode in (Mode.BRAKING, Mode.STOPPED):
            return result
        return replace(result, command=last.command, mode=last.mode, _planned=None)

    def room(self, poses: FloatArray) -> NDArray[np.bool_]:
        """Return (k,) True for the poses (k, 3) of a return path with enough distance from standing obstacles."""
        if self._standing is None:
            return np.ones(len(poses), dtype=bool)
        required_gap = self._required_gap()
        last = self._last
        if last is not None and math.isfinite(last.clearance):
            # A robot that is already nearer may keep its present distance.
            required_gap = min(required_gap, last.clearance - _PLAY)
        gaps, _ = min_gaps(self._footprint, self._standing, poses, np.zeros(len(poses)), required_gap + _PLAY)
        return gaps >= required_gap

    def _stale_reason(self, t: float) -> str:
        """Return the reason why the surroundings are too old or in the future; empty if they are current."""
        assert self._surroundings is not None
        time = self._surroundings.time
        if time is None or abs(t - time) <= self._settings.max_age:
            return ""
        limit = f"free_space.max_age is {self._settings.max_age:g} s"
        if time > t:
            return f"the surroundings are stamped {time - t:.2f} s in the future; {limit}"
        return f"the surroundings are {t - time:.2f} s old; {limit}"

    def _age(self, t: float) -> float:
        """Return the age of the surroundings [s]."""
        assert self._surroundings is not None
        return 0.0 if self._surroundings.time is None else t - self._surroundings.time

    def _clear_rows(self) -> None:
        rows = np.zeros((self._settings.rows, PARAMETERS))
        rows[:, -1] = 1.0
        self._tick.parameters[:, self._first : self._first + rows.size] = rows.ravel()
        self._owner[:] = -1

    def _set_rows(self, t: float, guide: FloatArray) -> None:
        """Set half-spaces around the plan of the previous tick, or around the reference if there is no plan."""
        assert self._pieces is not None
        guess, start = guide, guide[0]
        plan = None if self._last is None else self._last.plan
        if plan is not None:
            guess = np.vstack([plan[1:], 2.0 * plan[-1] - plan[-2]])
            start = plan[0]
        elif self._last is not None and self._last.estimate is not None:
            start = self._last.estimate.pose
        guess, guide, start = (np.ascontiguousarray(array, dtype=float) for array in (guess, guide, start))
        times = self._age(t) + self._stages
        self._lib.ddmpc_half_spaces(
            self._footprint.struct,
            self._pieces.struct,
            self._planning,
            len(times),
            address(guess),
            address(guide),
            address(start),
            address(times),
            address(self._spread),
            self._settings.rows,
            self._table.shape[1],
            address(self._table, "real *"),
            address(self._owner, "int *"),
        )
        self._tick.parameters[:, self._first : self._first + self._table.shape[1]] = self._table

    def _predict_covariances(self, result: StepResult) -> None:
        """Predict the covariances (N + 1, 9) of the poses along the plan."""
        planned = result.planned_commands
        commands = np.tile(result.command, (len(self._spread) - 1, 1)) if planned is None else np.array(planned)
        commands[0] = result.command
        commands = np.ascontiguousarray(commands)
        self._lib.ddmpc_spread(self._tick.c, address(commands), len(commands), address(self._spread, "real *"))

    def _ramp(self, sent: FloatArray) -> FloatArray:
        """Return the command (2,) after one sample of braking from the command `sent`."""
        limits, dt = self._config.limits, self._config.sample_time
        step = np.array([limits.v_braking, limits.omega_braking]) * dt
        command = np.sign(sent) * np.maximum(np.abs(sent) - step, 0.0)
        command[np.abs(command) < 1e-13] = 0.0
        return np.asarray(command, dtype=float)

    def _stopping_path(self, command: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predict poses (k + 1, 3) and twists (k + 1, 2) for `command`, followed by braking from the next tick on."""
        limits, dt = self._config.limits, self._config.sample_time
        step = np.array([limits.v_braking, limits.omega_braking]) * dt
        range_ramps = np.ceil((np.array([max(limits.v.sides), max(limits.omega.sides)]) / step).max())
        ramps = int(min(np.ceil((np.abs(command) / step).max()), max(range_ramps, _MAX_RAMP)))
        count = 1 + ramps + self._tick.window + int(_STOP_TIME / dt)
        decrease = np.arange(count)[:, None] * step
        commands = np.sign(command) * np.maximum(np.abs(command) - decrease, 0.0)
        poses, twists = np.empty((count + 1, 3)), np.empty((count + 1, 2))
        self._lib.ddmpc_roll(
            self._tick.c, address(commands), count, address(poses, "real *"), address(twists, "real *")
        )
        return poses, twists

    def _sweep(self, t: float, poses: FloatArray, twists: FloatArray) -> Any:  # noqa: ANN401 - cffi has no types
        """Check the stopping path for contacts; return a `ddmpc_contact`."""
        assert self._pieces is not None
        count = len(poses)
        times = self._age(t) + np.arange(count) * self._config.sample_time
        speeds = np.abs(twists[:, 0]) + np.abs(twists[:, 1]) * self._footprint.footprint.reach
        spread = np.ascontiguousarray(self._spread[np.minimum(np.arange(count), len(self._spread) - 1)])
        return self._lib.ddmpc_sweep(
            self._footprint.struct,
            self._pieces.struct,
            self._keeping,
            count,
            address(poses),
            address(times),
            address(speeds),
            address(spread),
            AT_REST,
            _PLAY,
            _MIN_RATIO * self._settings.margin,
        )

    def _clearances(self, t: float, pose: FloatArray, plan: FloatArray | None) -> tuple[float, float]:
        """Compute the present gap and the minimum gap along the plan [m]; infinity if no obstacle is near."""
        assert self._pieces is not None
        poses = np.ascontiguousarray(pose if plan is None else np.vstack([pose, plan[1:]]))
        times = self._age(t) + self._stages[: len(poses)]
        gaps, pieces = min_gaps(self._footprint, self._pieces, poses, times, self._keeping.reach)
        gaps[pieces < 0] = math.inf
        return float(gaps[0]), float(gaps.min())

    def _active_obstacles(self, plan: FloatArray | None) -> tuple[str, ...]:
        """Return the obstacles whose half-spaces are active in the plan, with the time of the first active stage."""
        if plan is None or self._pieces is None or (self._owner < 0).all():
            return ()
        rows = self._table.reshape(len(self._table), -1, PARAMETERS)
        cosine, sine = np.cos(plan[:, 2])[:, None], np.sin(plan[:, 2])[:, None]
        x = plan[:, :1] + cosine * rows[..., 2] - sine * rows[..., 3]
        y = plan[:, 1:2] + sine * rows[..., 2] + cosine * rows[..., 3]
        beyond = (rows[..., 0] * x + rows[..., 1] * y - rows[..., 4]) / self._settings.strictness
        stages, columns = np.nonzero((beyond > -_ACTIVE_WITHIN) & (self._owner >= 0))
        first_stages: dict[str, int] = {}
        for stage, column in zip(stages.tolist(), columns.tolist(), strict=True):
            first_stages.setdefault(self._pieces.names[self._owner[stage, column]], stage)
        return tuple(f"{name} in {stage * self._config.sample_time:.1f} s" for name, stage in first_stages.items())
