"""Ticks and their condensed problems in C: the numbers of `mpc.begin_tick` and `mpc.condensed`."""

from __future__ import annotations

import math

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, ReferenceSample
from diffdrive_mpc.mpc.bounds import slew_step
from diffdrive_mpc.mpc.compiled.constants import tracking_constants, tracking_sizes, vector
from diffdrive_mpc.mpc.compiled.library import bound_function, checked_constants, checked_size, load_library, pointer
from diffdrive_mpc.mpc.compiled.program import CompiledProgram
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.feed_forward import FeedForward
from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.mpc.tick import Tick

_SOURCES = ("condense.c", "relax.c", "least_distance.c")
_KINDS = 5


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
        self._plan, self._poses = np.zeros((N, 2)), np.zeros((N + 1, 3))
        parts = (self._constants, self._situation, self._tick_memory, self._plan, self._work, self._qp)
        at_constants, at_situation, at_tick, at_plan, at_work, at_qp = (pointer(part) for part in parts)
        self._begin = bound_function(library, "ddmpc_begin", at_constants, at_situation, at_tick)
        self._roll_out = bound_function(library, "ddmpc_poses", at_constants, at_tick, at_plan, pointer(self._poses))
        slew = slew_step(problem.config.limits, model.dt)
        self._program = CompiledProgram(
            library, program, slew, tick["last_command"], at_constants, at_tick, at_plan, at_work, at_qp
        )

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
        self._program.fill()
        return self._program

    def _load(self, tick: Tick, plan: FloatArray) -> None:
        self._plan[:] = plan
        if tick is not self._tick:
            self._side_slip[0] = tick.side_slip
            for name, target in self._tick_data.items():
                target[:] = getattr(tick, name)


def _memory(**shapes: tuple[int, ...]) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Memory of a struct of numbers, and its fields."""
    sizes = [math.prod(shape) for shape in shapes.values()]
    memory, ends = np.zeros(sum(sizes)), np.cumsum(sizes).tolist()
    return memory, {
        name: memory[end - size : end].reshape(shape)
        for (name, shape), size, end in zip(shapes.items(), sizes, ends, strict=True)
    }
