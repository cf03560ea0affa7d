"""Ticks of the closed loop in C: a velocity plant, its sensors and the compiled tick of a controller."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import AnyArray, CompiledController, ControlStep
from diffdrive_mpc.sim.core.library import load_twin, view
from diffdrive_mpc.sim.plants.model_plant import ModelPlant
from diffdrive_mpc.sim.recorder import Recorder


class CompiledLoop:
    """Loop in C that returns at ticks that need Python.

    Parameters
    ----------
    controller, plant
        Controller and plant at the start of a drive.
    record
        Recorder of the drive.
    ticks
        Number of ticks of the drive.
    """

    def __init__(self, controller: CompiledController, plant: ModelPlant, record: Recorder, ticks: int) -> None:
        ffi, self._lib = load_twin()
        self._plant, self._record, self._ticks = plant, record, ticks
        self._tick = tick = controller.compiled_tick()
        self._methods, self._iterations = np.zeros((2, ticks), dtype=np.intc)
        step = next(iter(tick.steps.values()))
        pairs = record.columns(view(plant.c.pose), view(plant.c.twist), step)
        columns: list[tuple[int, AnyArray, int]] = [
            (source.ctypes.data, table, source.nbytes) for source, table in pairs
        ]
        for name, counts in (("method", self._methods), ("iterations", self._iterations)):
            columns.append((tick.fields[name], counts, counts.itemsize))
        rows = [
            (ffi.cast("void *", source), ffi.cast("char *", table.ctypes.data), size, table.strides[0])
            for source, table, size in columns
        ]
        self._columns = ffi.new("loop_column[]", rows)
        types = dict(ffi.typeof("closed_loop").fields)
        fields = {name: ffi.cast(types[name].type, address) for name, address in tick.fields.items() if name in types}
        fields |= {"start": tick.start, "columns": self._columns, "column_count": len(rows)}
        self._loop = ffi.new("closed_loop *", fields)

    def run(self, k: int) -> tuple[int, ControlStep | None]:
        """Run ticks from tick `k` on; return the index of the next tick, and its step if C has already called it."""
        plant, remaining = self._plant, self._ticks - k
        if not self._tick.is_next():
            return k, None
        plant.sensors.draw_noise(remaining)
        count = self._lib.closed_loop_run(self._loop, plant.c, plant.sensors.c, k, remaining)
        if count:
            times, completed = np.arange(k, k + count) * plant.sample_time, slice(k, k + count)
            steps = [self._tick.steps[method] for method in self._methods[completed].tolist()]
            self._record.record_ticks(times, steps, self._iterations[completed])
            self._tick.record(float(times[-1]))
        return k + count, None if count == remaining else self._tick.complete(plant.time, self._loop.pending)
