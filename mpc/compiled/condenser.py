"""Ticks and their condensed problems in C: the numbers of `mpc.begin_tick` and `mpc.condensed`."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping

import numpy as np

from models.interface import FloatArray, ReferenceSample
from mpc.bounds import slew_step
from mpc.compiled.constants import tracking_constants, tracking_sizes, vector
from mpc.compiled.library import bound_function, callable_in, checked_constants, checked_size, load_library, pointer
from mpc.estimate import Estimate
from mpc.feed_forward import FeedForward
from mpc.problem import TrackingProblem
from mpc.tick import Tick

_SOURCES = ("condense.c",)
_KINDS = 5


class CompiledProgram:
    """Implements `mpc.quadratic_program.QuadraticProgram` on the memory of C; rows are written where asked for."""

    def __init__(
        self,
        data: Mapping[str, FloatArray],
        slew: FloatArray,
        last_command: FloatArray,
        values: Callable[[FloatArray], FloatArray],
        rows: Callable[[int], FloatArray],
    ) -> None:
        self.H, self.g, self.box = data["H"], data["g"], data["box"]
        self.soft_lower, self.soft_upper = data["soft_lower"], data["soft_upper"]
        self.slew, self.last_command = slew, last_command
        self.soft_values, self.soft_rows = values, rows

    @property
    def soft(self) -> FloatArray:
        """See `QuadraticProgram`."""
        return np.stack([self.soft_rows(kind) for kind in range(_KINDS)])


class CompiledCondenser:
    """Does in C what `mpc.begin_tick` and `mpc.condensed.Condenser` do, and has the latter's methods.

    A tick and a program are valid until the next of the same condenser.

    Raises
    ------
    mpc.compiled.compiler.NotCompiledError
        If it cannot be compiled.
    """

    def __init__(self, problem: TrackingProblem, feed_forward: FeedForward) -> None:
        N, model = problem.steps, problem.model
        library = load_library(_SOURCES, tracking_sizes(model, N, feed_forward))
        constants = vector(tracking_constants(problem, feed_forward))
        self._constants = checked_constants(library, "ddmpc_tracking_size", constants)
        self._work = np.zeros(checked_size(library, "ddmpc_workspace_size") // 8)
        samples = feed_forward.samples
        self._situation, start = _memory(
            mean=(model.order + 9,),
            past=(model.memory, 2),
            last_command=(2,),
            reference=(samples, 3),
            twist=(samples, 2),
        )
        self._start = start
        self._tick_memory, tick = _memory(
            pose=(3,),
            free_twist=(N + 1, 2),
            gains=(2,),
            side_slip=(1,),
            reference=(N + 1, 3),
            heading=(N + 1,),
            feed_forward=(N, 2),
            last_command=(2,),
        )
        self._side_slip = tick.pop("side_slip")
        self._tick_data, self._tick = tick, Tick(**tick, side_slip=0.0)
        self._qp, program = _memory(
            H=(2 * N, 2 * N), g=(2 * N,), box=(2 * N,), soft_lower=(_KINDS, N), soft_upper=(_KINDS, N)
        )
        self._program = CompiledProgram(
            program,
            slew_step(problem.config.limits, model.dt),
            tick["last_command"],
            self._soft_values,
            self._soft_rows,
        )
        self._plan, self._poses, self._values = np.zeros((N, 2)), np.zeros((N + 1, 3)), np.zeros((_KINDS, N))
        self._rows = np.zeros((N, 2 * N))

        address = ctypes.c_void_p
        parts = (self._constants, self._situation, self._tick_memory, self._plan, self._work, self._qp)
        constants_at, situation_at, tick_at, plan_at, work_at, qp_at = (pointer(part) for part in parts)
        self._begin = bound_function(library, "ddmpc_begin", constants_at, situation_at, tick_at)
        self._condense = bound_function(library, "ddmpc_condense", constants_at, tick_at, plan_at, work_at, qp_at)
        self._roll_out = bound_function(library, "ddmpc_poses", constants_at, tick_at, plan_at, pointer(self._poses))
        self._write_values = bound_function(
            library, "ddmpc_soft_values", constants_at, tick_at, work_at, plan_at, pointer(self._values)
        )
        rows_at = pointer(self._rows)
        write_rows = callable_in(library, "ddmpc_soft_rows", None, address, address, address, ctypes.c_int, address)
        self._write_rows = lambda kind: write_rows(constants_at, tick_at, work_at, kind, rows_at)

    def begin(self, estimate: Estimate, past: FloatArray, last_command: FloatArray, sample: ReferenceSample) -> Tick:
        """See `mpc.begin_tick.begin_tick`."""
        start = self._start
        start["mean"][:] = estimate.mean
        start["past"][:] = past
        start["last_command"][:] = last_command
        start["reference"][:] = sample.pose
        start["twist"][:] = sample.twist
        self._begin()
        self._tick.side_slip = float(self._side_slip[0])
        return self._tick

    def poses(self, tick: Tick, plan: FloatArray) -> FloatArray:
        """See `Condenser.poses`."""
        self._load(tick, plan)
        self._roll_out()
        return self._poses.copy()

    def condense(self, tick: Tick, plan: FloatArray) -> CompiledProgram:
        """See `Condenser.condense`."""
        self._load(tick, plan)
        self._condense()
        return self._program

    def _load(self, tick: Tick, plan: FloatArray) -> None:
        self._plan[:] = plan
        if tick is not self._tick:
            self._side_slip[0] = tick.side_slip
            for name, target in self._tick_data.items():
                target[:] = getattr(tick, name)

    def _soft_values(self, plan: FloatArray) -> FloatArray:
        self._plan.reshape(-1)[:] = plan
        self._write_values()
        return self._values

    def _soft_rows(self, kind: int) -> FloatArray:
        self._write_rows(kind)
        return self._rows.copy()


def _memory(**shapes: tuple[int, ...]) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Memory of a struct of numbers, and its fields."""
    sizes = [math.prod(shape) for shape in shapes.values()]
    memory, ends = np.zeros(sum(sizes)), np.cumsum(sizes).tolist()
    return memory, {
        name: memory[end - size : end].reshape(shape)
        for (name, shape), size, end in zip(shapes.items(), sizes, ends, strict=True)
    }
