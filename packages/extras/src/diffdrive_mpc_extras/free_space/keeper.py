"""Keeps one controller in free space: half-spaces for its plan, and the check of its way to rest after each solve."""

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
    Known,
    Pieces,
    PlacedFootprint,
    address,
    least_gaps,
    load_free_space,
    pieces_of,
)
from diffdrive_mpc_extras.free_space.polygons import Footprint
from diffdrive_mpc_extras.free_space.surroundings import Surroundings

AT_REST = 0.02
"""Slower than this a robot does no harm [m/s]."""
# Obstacles farther than this beyond the margin get no half-space [m]; a plan of one horizon may deviate by that much.
_NEAR = 0.5
# An obstacle nearer than the margin may come nearer by this distance [m]; but not below this ratio of the margin.
_PLAY, _LEAST_SHARE = 0.004, 0.5
# Time after its last command within which every robot stops [s].
_ROLLS_ON = 0.6
# Samples of braking that are checked, or those from the end of the range: the time of a tick is limited, also for fast
# commands.
_MOST_RAMP = 1000
# A slower disc counts as standing: the robot drives around it and does not wait for it [m/s].
_STANDS = 0.05
# Ticks from one search of a way to the next, and after a change of the surroundings.
_EVERY, _SOON = 5, 3
# Distance to the end of the way at which the robot stops [m].
_AT_END = 0.03
# A plan this near to a plane is pressed against it [m].
_TOUCHES = 0.002


class FreeSpaceKeeper:
    """Free space of one controller: its surroundings, and its effect on the tick.

    Parameters
    ----------
    config
        With `free_space.enabled`.
    tick
        The controller's tick.
    first
        Place of the first half-space's parameters among those of all terms.
    """

    def __init__(self, config: ControllerConfig, tick: Tick, first: int) -> None:
        self._tick, self._first = tick, first
        ffi, self._lib = load_free_space()
        settings = free_space_of(config)
        self._footprint = PlacedFootprint(Footprint(settings.corners, settings.footprint_radius))
        self._pieces: Pieces | None = None
        self._known: Known = {}
        self._around: Surroundings | None = None
        self._reference: Reference | None = None
        self._guide: Guide | None = None
        self._closed_by = "something"
        self._crossing: Crossing | None = None
        self._standing: Pieces | None = None
        self._moving: Pieces | None = None
        self._since_search, self._news = _EVERY, False
        self.pace = math.inf
        """Largest progress rate of the reference now [-]."""
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
        """Use other limits from now on."""
        self._config, self._settings = config, free_space_of(config)
        settings = self._settings
        for keeping, margin in (
            (self._keeping, settings.margin),
            (self._planning, settings.margin + settings.reserve),
        ):
            keeping.margin, keeping.factor, keeping.doubt = margin, settings.uncertainty_factor, settings.disc_doubt
            keeping.moving = settings.moving_margin
            keeping.reach, keeping.scale = margin + settings.moving_margin + _NEAR, settings.strictness

    def set_obstacles(self, around: Surroundings | None) -> None:
        """Keep clear of `around` from the next step on.

        Raises
        ------
        SurroundingsError
            If something in it cannot be used; then nothing changes.
        """
        pieces = None if around is None else pieces_of(around, self._settings, self._reference, self._known)
        self._take(around, pieces)
        if pieces is None:
            self._clear_rows()

    def _take(self, around: Surroundings | None, pieces: Pieces | None) -> None:
        self._around, self._pieces, self._news = around, pieces, True
        self._standing = self._moving = None
        if pieces is not None:
            stands = np.hypot(pieces.velocity[:, 0], pieces.velocity[:, 1]) <= _STANDS
            self._standing = pieces if stands.all() else pieces.chosen(stands)
            self._moving = None if stands.all() else pieces.chosen(~stands)

    def start(self, reference: Reference) -> Reference:
        """Start another reference; return it as it will be driven, moved aside around obstacles."""
        self._reference, self._last = reference, None
        table = PathTable.build(reference)
        self._guide = Guide(table, self._footprint, self._settings)
        self._since_search, self.pace, self._crossing = _EVERY, math.inf, None
        if self._around is not None and self._around.corridor is not None:
            self._take(self._around, pieces_of(self._around, self._settings, reference, self._known))
        return BentReference(reference, self._guide)

    def forget(self) -> None:
        """Reset."""
        self._last = None

    def before(self, t: float, time: float, tracked: Reference) -> Hold | None:
        """Prepare the tick at `t` [s]: a reason to stop, or half-spaces for the plan and a rate for the reference.

        `time` [s] is the approximate present time of the reference, and `tracked` the motion to track: it, or the way
        back to it.
        """
        self.pace = math.inf
        if self._pieces is None or self._guide is None:
            return None
        stale = self._stale(t)
        if stale:
            return Hold(stale)
        reason = self._find_way(t, time)
        if reason:
            return Hold(reason)
        self._set_rows(t, tracked.sample(time + self._stages).pose)
        return None

    def _find_way(self, t: float, time: float) -> str:
        """Search a path and choose the speed of the reference; return the reason to stop, if any."""
        guide, reference = self._guide, self._reference
        assert guide is not None and reference is not None and self._standing is not None
        sample = reference.sample([time])
        arc, speed = float(sample.arc_length[0]), abs(float(sample.twist[0, 0]))
        last = self._last
        v = 0.0 if last is None or last.estimate is None else float(last.estimate.twist[0])
        self._since_search += 1
        if self._since_search >= (_SOON if self._news else _EVERY):
            self._since_search, self._news = 0, False
            guide.update(arc, v, self._standing, (self._keeps(), _LEAST_SHARE * self._settings.margin), self._top())
            # Named now: the surroundings may change until the next search.
            self._closed_by = self._standing.names[guide.blocked_by] if guide.blocked_by >= 0 else "something"
        self._crossing = None
        if self._moving is not None:
            keeps = self._planning.margin + self._settings.moving_margin
            self._crossing = crossing(
                guide, self._footprint, self._moving, self._settings, (arc, abs(v), speed), self._since(t), keeps
            )
            beside = self._right_beside(t)
            if beside:
                self.pace = 0.0
                return beside
        ends = min(guide.ends, self._crossing.ends if self._crossing else math.inf)
        most = guide.speed_now(arc, ends)
        if math.isfinite(most):
            stretch = float(np.hypot(1.0, guide.slope[guide.node(arc)]))
            self.pace = most / max(speed * stretch, STANDING)
        if ends - arc > _AT_END:
            return ""
        self.pace = 0.0
        return self._why_not()

    def _right_beside(self, t: float) -> str:
        """Describe the moving object that a standing robot lets pass; empty without one."""
        last = self._last
        if last is None or last.estimate is None or self._moving is None:
            return ""
        v, omega = last.estimate.twist.tolist()
        if abs(v) + abs(omega) * self._footprint.footprint.reach > 2.0 * AT_REST:
            return ""
        now = np.array([self._since(t)])
        keeps = self._keeps() + self._settings.moving_margin
        (gap,), (piece,) = least_gaps(self._footprint, self._moving, last.estimate.pose[None], now, keeps)
        return f"waits for {self._moving.names[piece]}, which is {max(gap, 0.0):.2f} m beside it" if piece >= 0 else ""

    def _why_not(self) -> str:
        """Describe why the path ends."""
        assert self._guide is not None
        crosses, ends = self._crossing, self._guide.ends
        if crosses is not None and crosses.ends <= ends and self._moving is not None:
            return f"waits for {self._moving.names[crosses.piece]}, which crosses its way"
        return f"no way: blocked by {self._closed_by}; waits for other surroundings or another path"

    def _keeps(self) -> float:
        """Compute the gap that a path needs [m]: the plan's, plus the uncertainty of the present position."""
        spread = self._spread[0]
        return float(self._planning.margin + self._planning.factor * math.sqrt(max(spread[0], spread[4], 0.0)))

    def _top(self) -> tuple[float, float, float]:
        """Return maximum yaw rate [rad/s], lateral acceleration [m/s^2] and speed [m/s] of a path."""
        config = self._config
        effort = config.reentry.effort
        return effort * config.limits.omega, load_robot().reference_acceleration.lateral, config.limits.v

    def after(self, t: float, result: StepResult, sent: FloatArray) -> StepResult:
        """Check the braking path after the tick's command; brake before it is not free.

        `sent` (2,) is the last command before this one.
        """
        self._last, self._braked = result, False
        if self._pieces is None or result.estimate is None or self._around is None:
            return result
        settings = self._settings
        self._find_spread(result)
        driving = result.mode in (Mode.TRACKING, Mode.REUSED_PLAN)
        poses, twists = self._way_to_rest(result.command)
        contact = self._sweep(t, poses, twists)
        clearance, ahead = self._clearances(t, poses[:1], result.plan)
        ahead = min(ahead, contact.least if contact.least < self._keeping.reach else math.inf)
        result = replace(result, clearance=clearance, clearance_ahead=ahead, pressed_by=self._pressed(result.plan))
        if contact.sample < 0 or not driving:
            return result
        command = self._ramp(sent)
        self._tick.set_applied_commands(command[None])
        words = (
            f"braking: on its way to rest it would come within {max(contact.gap, 0.0):.2f} m of "
            f"{self._pieces.names[contact.piece]}; free_space.margin is {settings.margin:g} m"
        )
        self._braked, stands = True, not command.any()
        self._last = replace(
            result,
            command=command,
            mode=Mode.STOPPED if stands else Mode.BRAKING,
            message="; ".join(filter(None, (result.message, words))),
            _planned=None,
        )
        return self._last

    def again(self, result: StepResult) -> StepResult:
        """Handle a repeated call: if it would repeat a command that was braked instead, repeat the braked one."""
        last = self._last
        if last is None or not self._braked or result.mode in (Mode.BRAKING, Mode.STOPPED):
            return result
        return replace(result, command=last.command, mode=last.mode, _planned=None)

    def room(self, poses: FloatArray) -> NDArray[np.bool_]:
        """Return (k,) True if there is room at poses (k, 3) for a path back, next to standing obstacles."""
        if self._standing is None:
            return np.ones(len(poses), dtype=bool)
        keeps = self._keeps()
        last = self._last
        if last is not None and math.isfinite(last.clearance):
            # A robot that is already too near may drive at this distance.
            keeps = min(keeps, last.clearance - _PLAY)
        gaps, _ = least_gaps(self._footprint, self._standing, poses, np.zeros(len(poses)), keeps + _PLAY)
        return gaps >= keeps

    def _stale(self, t: float) -> str:
        """Describe why the surroundings are unusable; empty if they are usable."""
        assert self._around is not None
        time = self._around.time
        if time is None or abs(t - time) <= self._settings.max_age:
            return ""
        most = f"free_space.max_age is {self._settings.max_age:g} s"
        if time > t:
            return f"the surroundings are stamped {time - t:.2f} s in the future; {most}"
        return f"the surroundings are {t - time:.2f} s old; {most}"

    def _since(self, t: float) -> float:
        """Return the age of the surroundings [s]."""
        assert self._around is not None
        return 0.0 if self._around.time is None else t - self._around.time

    def _clear_rows(self) -> None:
        rows = np.zeros((self._settings.rows, PARAMETERS))
        rows[:, -1] = 1.0
        self._tick.parameters[:, self._first : self._first + rows.size] = rows.ravel()
        self._owner[:] = -1

    def _set_rows(self, t: float, guide: FloatArray) -> None:
        """Set half-spaces around the plan of the last tick, or around the target without one."""
        assert self._pieces is not None
        guess, start = guide, guide[0]
        plan = None if self._last is None else self._last.plan
        if plan is not None:
            guess = np.vstack([plan[1:], 2.0 * plan[-1] - plan[-2]])
            start = plan[0]
        elif self._last is not None and self._last.estimate is not None:
            start = self._last.estimate.pose
        guess, guide, start = (np.ascontiguousarray(array, dtype=float) for array in (guess, guide, start))
        times = self._since(t) + self._stages
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

    def _find_spread(self, result: StepResult) -> None:
        """Compute covariances (N + 1, 9) of the predicted poses along the plan."""
        planned = result.planned_commands
        commands = np.tile(result.command, (len(self._spread) - 1, 1)) if planned is None else np.array(planned)
        commands[0] = result.command
        commands = np.ascontiguousarray(commands)
        self._lib.ddmpc_spread(self._tick.c, address(commands), len(commands), address(self._spread, "real *"))

    def _ramp(self, sent: FloatArray) -> FloatArray:
        """Compute the command (2,) after one sample of braking."""
        limits, dt = self._config.limits, self._config.sample_time
        step = np.array([limits.v_braking, limits.omega_braking]) * dt
        command = np.sign(sent) * np.maximum(np.abs(sent) - step, 0.0)
        command[np.abs(command) < 1e-13] = 0.0
        return np.asarray(command, dtype=float)

    def _way_to_rest(self, command: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute poses (k + 1, 3) and twists (k + 1, 2) for `command` now, and braking from the next tick on."""
        limits, dt = self._config.limits, self._config.sample_time
        step = np.array([limits.v_braking, limits.omega_braking]) * dt
        from_range = np.ceil((np.array([max(limits.v.sides), max(limits.omega.sides)]) / step).max())
        ramps = int(min(np.ceil((np.abs(command) / step).max()), max(from_range, _MOST_RAMP)))
        count = 1 + ramps + self._tick.window + int(_ROLLS_ON / dt)
        less = np.arange(count)[:, None] * step
        commands = np.sign(command) * np.maximum(np.abs(command) - less, 0.0)
        poses, twists = np.empty((count + 1, 3)), np.empty((count + 1, 2))
        self._lib.ddmpc_roll(
            self._tick.c, address(commands), count, address(poses, "real *"), address(twists, "real *")
        )
        return poses, twists

    def _sweep(self, t: float, poses: FloatArray, twists: FloatArray) -> Any:  # noqa: ANN401 - cffi has no types
        """Check the stopping path for contacts; return a `ddmpc_contact`."""
        assert self._pieces is not None
        count = len(poses)
        times = self._since(t) + np.arange(count) * self._config.sample_time
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
            _LEAST_SHARE * self._settings.margin,
        )

    def _clearances(self, t: float, pose: FloatArray, plan: FloatArray | None) -> tuple[float, float]:
        """Compute the present gap, and the least gap along the plan; infinity without obstacles nearby."""
        assert self._pieces is not None
        poses = np.ascontiguousarray(pose if plan is None else np.vstack([pose, plan[1:]]))
        times = self._since(t) + self._stages[: len(poses)]
        gaps, pieces = least_gaps(self._footprint, self._pieces, poses, times, self._keeping.reach)
        gaps[pieces < 0] = math.inf
        return float(gaps[0]), float(gaps.min())

    def _pressed(self, plan: FloatArray | None) -> tuple[str, ...]:
        """Name the obstacles that limit the plan."""
        if plan is None or self._pieces is None or (self._owner < 0).all():
            return ()
        rows = self._table.reshape(len(self._table), -1, PARAMETERS)
        cosine, sine = np.cos(plan[:, 2])[:, None], np.sin(plan[:, 2])[:, None]
        x = plan[:, :1] + cosine * rows[..., 2] - sine * rows[..., 3]
        y = plan[:, 1:2] + sine * rows[..., 2] + cosine * rows[..., 3]
        beyond = (rows[..., 0] * x + rows[..., 1] * y - rows[..., 4]) / self._settings.strictness
        stages, columns = np.nonzero((beyond > -_TOUCHES) & (self._owner >= 0))
        first: dict[str, int] = {}
        for stage, column in zip(stages.tolist(), columns.tolist(), strict=True):
            first.setdefault(self._pieces.names[self._owner[stage, column]], stage)
        return tuple(f"{name} in {stage * self._config.sample_time:.1f} s" for name, stage in first.items())
