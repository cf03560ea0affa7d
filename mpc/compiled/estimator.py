"""The estimator in C: the numbers of `mpc.estimator.StateEstimator`, in a small part of its time."""

from __future__ import annotations

import ctypes

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import Measurement
from diffdrive_mpc.mpc.command_line import CommandLine
from diffdrive_mpc.mpc.compiled.constants import estimation_constants, estimator_sizes, vector
from diffdrive_mpc.mpc.compiled.library import callable_in, checked_constants, checked_size, load_library, pointer
from diffdrive_mpc.mpc.compiled.messages import MeasurementBuffer, NotesBuffer
from diffdrive_mpc.mpc.config.schema import Compensation, Estimator, Wheels
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.estimator import build_filter, correct_sent, history_ticks

_READY, _MOVED = 1, 2
_SOURCES = ("estimator.c", "filter.c", "checks.c")


class CompiledEstimator:
    """The same as `mpc.estimator.StateEstimator`, whose parameters and methods it has.

    Raises
    ------
    mpc.compiled.compiler.NotCompiledError
        If it cannot be compiled.
    """

    def __init__(
        self,
        model: DiscreteModel,
        settings: Estimator,
        compensation: Compensation | None = None,
        wheels: Wheels | None = None,
    ) -> None:
        self._settings, self._order = settings, model.order
        length = history_ticks(settings, model.dt)
        self._longest_pause = length * model.dt
        library = load_library(_SOURCES, estimator_sizes(model, length))
        constants = vector(estimation_constants(model, settings, build_filter(model, settings, compensation, wheels)))
        self._constants = checked_constants(library, "ddmpc_estimation_size", constants)
        self._memory = np.zeros(checked_size(library, "ddmpc_estimator_size") // 8)
        self._output = np.zeros(2 * model.order + 28)
        self._measurement, self._notes = MeasurementBuffer(), NotesBuffer(settings)
        self._at_constants, self._at_memory = pointer(self._constants), pointer(self._memory)
        self._at_output = pointer(self._output)

        address, time, bits = ctypes.c_void_p, ctypes.c_double, ctypes.c_int
        self._init = callable_in(library, "ddmpc_estimator_init", None, address)
        self._forget = callable_in(library, "ddmpc_estimator_forget", None, address)
        self._advance = callable_in(library, "ddmpc_estimator_advance", None, address, address, time)
        self._update = callable_in(library, "ddmpc_estimator_update", bits, address, address, time, address, address)
        self._restart = callable_in(library, "ddmpc_estimator_restart_elsewhere", bits, address, address)
        self._estimate = callable_in(library, "ddmpc_estimator_estimate", None, address, address, address)

        self._init(self._at_memory)
        # The commands are the first in the memory of ddmpc_estimator.
        count = model.memory + length + 2
        self.commands = CommandLine(model, length, self._memory[: 2 * count].reshape(count, 2))
        self._newest: Estimate | None = None
        self._state = 0

    def forget(self) -> None:
        """See `StateEstimator.forget`."""
        self._newest, self._state = None, 0
        self._forget(self._at_memory)

    @property
    def ready(self) -> bool:
        """See `StateEstimator.ready`."""
        return bool(self._state & _READY)

    @property
    def moved(self) -> bool:
        """See `StateEstimator.moved`."""
        return bool(self._state & _MOVED)

    @property
    def longest_pause(self) -> float:
        """See `StateEstimator.longest_pause`."""
        return self._longest_pause

    @property
    def estimate(self) -> Estimate:
        """See `StateEstimator.estimate`."""
        if self._newest is None:
            self._estimate(self._at_constants, self._at_memory, self._at_output)
            self._newest = Estimate(self._output.copy(), self._order)
        return self._newest

    def correct_sent(self, sent: tuple[float, float] | None) -> list[str]:
        """See `StateEstimator.correct_sent`."""
        return correct_sent(self.commands, sent, self._settings)

    def advance(self, t: float) -> None:
        """See `StateEstimator.advance`."""
        self._newest = None
        self._advance(self._at_constants, self._at_memory, t)

    def update(self, t: float, measurement: Measurement) -> list[str]:
        """See `StateEstimator.update`."""
        self._newest = None
        self._measurement.fill(measurement)
        notes = self._notes
        self._state = self._update(self._at_constants, self._at_memory, t, self._measurement.address, notes.address)
        return notes.sentences()

    def restart_elsewhere(self) -> bool:
        """See `StateEstimator.restart_elsewhere`."""
        self._newest = None
        restarted = bool(self._restart(self._at_constants, self._at_memory))
        if restarted:
            self._state = _READY
        return restarted
