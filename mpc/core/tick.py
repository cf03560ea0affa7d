"""Python interface of the compiled tick: constants and results by the names of their fields in C.

Only `core.h` defines the memory layout. cffi parses the structs of this header; the shape of each array is in the
comment after its pointer. A missing or unknown name or a wrong shape raises ValueError. The steps of a tick are in
`tick.c`, and the Python part of a tick is in `mpc/controller.py`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped
from diffdrive_mpc.models.velocity_model import ModelError
from diffdrive_mpc.mpc.core.library import constant_fields, load_core, pointer_shapes
from diffdrive_mpc.mpc.problem.constants import Constants


class Tick:
    """Controller in C with its own memory.

    Parameters
    ----------
    sizes, constants
        Fields of `ddmpc_sizes` and `ddmpc_constants`.
    functions
        Addresses of the step and output functions of a nonlinear model; None for a linear model.
    terms
        Terms of the user as `generate.CompiledTerm`.

    Raises
    ------
    models.velocity_model.ModelError
        If a size exceeds the maximum of the core.
    """

    def __init__(
        self,
        sizes: Mapping[str, int],
        constants: Constants,
        functions: tuple[Any, Any] | None = None,
        terms: Sequence[tuple[Any, int, bool, int]] = (),
    ) -> None:
        ffi, self.lib = load_core()
        self.ffi, self._sizes = ffi, dict(sizes)
        self._c_sizes = ffi.new("ddmpc_sizes *", dict(sizes))
        self._constants = self.prepare(constants)
        self._terms = ffi.new("ddmpc_term[]", [(function, rows, soft, first) for function, rows, soft, first in terms])
        step, output = functions or (ffi.NULL, ffi.NULL)
        self._functions = ffi.new("ddmpc_functions *", {"step": step, "output": output, "terms": self._terms})
        reals, ints = self.lib.ddmpc_reals(self._c_sizes), self.lib.ddmpc_ints(self._c_sizes)
        self._reals, self._ints = np.zeros(max(reals, 1)), np.zeros(max(ints, 1), dtype=np.intc)
        # The core does not allocate memory, so these objects provide it and must live as long as the controller.
        self._nodes = ffi.new("char[]", max(1, sizes["history"] * self.lib.ddmpc_node_bytes()))
        # Memory from cffi is aligned for any type.
        self._memory = ffi.new("char[]", self.lib.ddmpc_controller_bytes())
        self.c = ffi.cast("ddmpc_controller *", self._memory)
        is_initialised = self.lib.ddmpc_init(
            self.c,
            self._c_sizes,
            self._constants[0],
            self._functions,
            self._address("real *", self._reals),
            self._address("int *", self._ints),
            self._nodes,
        )
        if not is_initialised:
            raise ModelError(
                f"a model of order {sizes['states']} with {sizes['window']} pending commands, a horizon of "
                f"{sizes['steps']} and {sizes['soft']} soft limits exceeds the maximum of the core (64, 512, 200, 60); "
                "identify a model of lower order"
            )
        self.result = self.lib.ddmpc_result_of(self.c)
        self.samples: int = self.lib.ddmpc_samples(self.c)
        self.layout = ResultLayout(self)
        self.input = MeasurementBuffer(ffi)
        self.reference: Any = None

    def _address(self, kind: str, array: np.ndarray[Any, Any]) -> Any:  # noqa: ANN401 - cffi has no types
        return self.ffi.cast(kind, array.ctypes.data)

    def prepare(self, values: Constants) -> tuple[Any, list[FloatArray]]:
        """Build a `ddmpc_constants`; return it with the arrays that it points to, which must live as long.

        Raises
        ------
        ValueError
            If a field is missing or unknown, or its shape differs from the one in core.h.
        """
        struct, arrays = self.ffi.new("ddmpc_constants *"), []
        for name, value in constant_fields(self._sizes, values):
            if isinstance(value, np.ndarray):
                arrays.append(value)
                setattr(struct, name, self._address("const real *", value))
            else:
                setattr(struct, name, value)
        return struct, arrays

    def configure(self, constants: tuple[Any, list[FloatArray]]) -> None:
        """Replace the constants by the result of `prepare` for constants of the same sizes."""
        self.lib.ddmpc_configure(self.c, constants[0])
        self._constants = constants

    def set_initial_slip(self, slip: Sequence[float]) -> None:
        """Set the initial slip of the estimate at later starts, until `configure` is called.

        `slip` has 10 entries, or 15 with curved slip, in the order of `SLIPS`.
        """
        for i, value in enumerate(slip):
            self._constants[0].prior[i] = value

    def view(self, address: Any, shape: tuple[int, ...]) -> FloatArray:  # noqa: ANN401 - cffi has no types
        """View the numbers at a C address as an array, without a copy."""
        count = int(np.prod(shape))
        return np.frombuffer(self.ffi.buffer(address, 8 * count), dtype=float).reshape(shape)

    @property
    def parameters(self) -> FloatArray:
        """(N + 1, P) stage parameters of the user's terms."""
        shape = (self._sizes["steps"] + 1, self._sizes["parameters"])
        return self.view(self.lib.ddmpc_parameters(self.c), shape) if shape[1] else np.zeros(shape)

    @property
    def window(self) -> int:
        """Maximum number of pending commands."""
        return self._sizes["window"]

    @property
    def last_command(self) -> FloatArray:
        """(2,) copy of the last sent command."""
        return self.view(self.lib.ddmpc_last_command(self.c), (2,)).copy()

    def set_applied_commands(self, commands: FloatArray) -> None:
        """Replace the last K commands by `commands` (K, 2), which must be finite."""
        pairs = np.ascontiguousarray(commands, dtype=float)
        self.lib.ddmpc_set_applied_commands(self.c, self._address("const real *", pairs), len(pairs))

    def newest_belief(self) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return copies of the filter's newest mean (Z,) and covariance (Z, Z), and of the preceding commands (W, 2).

        The result is None if there is no estimate.
        """
        size = self._sizes["states"] + self._sizes["slips"] + 6
        mean, covariance, sent = np.zeros(size), np.zeros((size, size)), np.zeros((self._sizes["window"], 2))
        arrays = (mean, covariance, sent)
        is_known = self.lib.ddmpc_newest_belief(self.c, *(self._address("real *", array) for array in arrays))
        return arrays if is_known else None

    def predict_belief(
        self, mean: FloatArray, covariance: FloatArray, commands: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Predict mean and covariance over K samples from `commands` (W + K, 2): W earlier and K new commands."""
        commands, window = np.ascontiguousarray(commands, dtype=float), self._sizes["window"]
        current, following = [np.array(mean), np.array(covariance)], [np.empty_like(mean), np.empty_like(covariance)]
        for first in range(len(commands) - window):
            arrays = (commands[first : first + window + 1], *current, *following)
            self.lib.ddmpc_predict_belief(self.c, *(self._address("real *", array) for array in arrays))
            # Input and output arrays must not overlap, so two pairs alternate.
            current, following = following, current
        return current[0], current[1]

    def addresses(self) -> dict[str, int]:
        """Return the addresses of step, input and result, by the names of `models.interface.CompiledTick`."""
        ffi, struct, result = self.ffi, self.input.struct, self.result
        pointers = {"step": ffi.addressof(self.lib, "ddmpc_step"), "controller": self.c, "input": struct}
        names = ("pose", "wheels", "yaw_rate", "sent", "has_sent", "reference_time")
        pointers |= {name: ffi.addressof(struct[0], name) for name in names}
        # Simulations compare these values with 0, the code of the mode TRACKING and of the status SOLVED.
        pointers |= {name: ffi.addressof(result[0], name) for name in ("mode", "reasons", "notes")}
        report = {"status": "status", "method": "path", "iterations": "iterations"}
        pointers |= {name: ffi.addressof(result.solver, field) for name, field in report.items()}
        pointers["command"] = result.command
        return {name: int(ffi.cast("uintptr_t", pointer)) for name, pointer in pointers.items()}

    def stray(self, pose: FloatArray, twist: FloatArray) -> Any:  # noqa: ANN401 - cffi has no types
        """Compare the estimate with a reference pose (3,) with twist (2,); return a `ddmpc_stray`.

        Raises ValueError if a shape is wrong.
        """
        pose, twist = _checked_array("pose", pose, (3,)), _checked_array("twist", twist, (2,))
        address = self._address
        return self.lib.ddmpc_stray_from(self.c, address("const real *", pose), address("const real *", twist))

    def track(self, poses: FloatArray, twists: FloatArray, share: float) -> int:
        """Continue the tick with a target: poses (samples, 3) and twists (samples, 2), from the current tick on.

        `share` is the maximum command as a share of the limits [-]. The result is a value of `ddmpc_pending`. Raises
        ValueError if a shape is wrong.
        """
        poses = _checked_array("poses", poses, (self.samples, 3))
        twists = _checked_array("twists", twists, (self.samples, 2))
        address = self._address
        return int(self.lib.ddmpc_track(self.c, address("real *", poses), address("real *", twists), share))


class ResultLayout:
    """Layout of the arrays of a result in one block of memory, which is copied as a whole.

    Attributes
    ----------
    slip
        Slice of the slip in the mean of the filter's state.
    slices
        Slice in the block and shape of each array, by name.
    live
        Block in the memory of the core, which the next tick overwrites.
    """

    def __init__(self, tick: Tick) -> None:
        n = tick._sizes["states"]
        self.slip = slice(n, n + tick._sizes["slips"])
        result, ffi = tick.result, tick.ffi
        shapes = {
            name: (getattr(owner, name), shape)
            for struct, owner in (("ddmpc_estimate", result.estimate), ("ddmpc_result", result))
            for name, shape in pointer_shapes(struct, tick._sizes).items()
        }
        # memory.c allocates the arrays of a result in one block, so one copy per tick is sufficient.
        addresses = {name: int(ffi.cast("uintptr_t", address)) for name, (address, _) in shapes.items()}
        first = min(addresses.values())
        self.slices: dict[str, tuple[slice, tuple[int, ...]]] = {}
        end = 0
        for name, (_, shape) in shapes.items():
            start, count = (addresses[name] - first) // 8, int(np.prod(shape))
            self.slices[name] = (slice(start, start + count), shape)
            end = max(end, start + count)
        self.live = np.frombuffer(ffi.buffer(ffi.cast("real *", first), 8 * end), dtype=float)

    def copy(self) -> FloatArray:
        """Return a read-only copy of all arrays of the current result."""
        block = self.live.copy()
        block.flags.writeable = False
        return block

    def take(self, block: FloatArray, name: str) -> FloatArray:
        """Return the array `name` of a copied block."""
        place, shape = self.slices[name]
        return block[place] if len(shape) == 1 else block[place].reshape(shape)


class MeasurementBuffer:
    """Memory of a `ddmpc_input`. Values that are not numbers become NaN, which the core rejects with a note."""

    def __init__(self, ffi: Any) -> None:  # noqa: ANN401 - cffi has no types
        self.struct = ffi.new("ddmpc_input *")
        whole = memoryview(ffi.buffer(self.struct)).cast("B")

        def numbers(offset: int, count: int) -> Any:  # noqa: ANN401 - a view of doubles
            return whole[offset : offset + 8 * count].cast("d")

        def message(field: str, count: int) -> _Message:
            base = ffi.offsetof("ddmpc_input", field)
            value, covariance = (base + ffi.offsetof("ddmpc_stamped", part) for part in ("value", "covariance"))
            return _Message(
                getattr(self.struct, field), numbers(value, count), numbers(covariance, count * count), count
            )

        self._pose, self._wheels = message("pose", 3), message("wheels", 2)
        self._yaw_rate = message("yaw_rate", 1)
        self._sent = numbers(ffi.offsetof("ddmpc_input", "sent"), 2)

    def fill(self, measurement: Measurement) -> None:
        """Copy the measurements of this tick."""
        self._pose.fill(measurement.pose)
        self._wheels.fill(measurement.wheel_twist)
        self._yaw_rate.fill(measurement.yaw_rate)
        sent = measurement.sent
        self.struct.has_sent = sent is not None
        if sent is not None:
            try:
                # Fast path for two numbers, the usual case.
                self._sent[0], self._sent[1] = sent
            except (TypeError, ValueError):
                _write(self._sent, sent, 2)


class _Message:
    """Memory of a `ddmpc_stamped`."""

    __slots__ = ("_count", "_covariance", "_struct", "_value")

    def __init__(self, struct: Any, value: Any, covariance: Any, count: int) -> None:  # noqa: ANN401
        self._struct, self._value, self._covariance, self._count = struct, value, covariance, count

    def fill(self, stamped: Stamped | None) -> None:
        struct = self._struct
        if stamped is None:
            struct.present = 0
            return
        struct.present = 1
        try:
            struct.stamp = stamped.time
        except (TypeError, ValueError, OverflowError):
            struct.stamp = math.nan
        _write(self._value, stamped.value, self._count)
        covariance = stamped.covariance
        struct.has_covariance = covariance is not None
        if covariance is not None:
            flat = covariance.reshape(-1) if isinstance(covariance, np.ndarray) else covariance
            _write(self._covariance, flat, self._count * self._count)


def _checked_array(name: str, values: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return `values` as a C-contiguous array; raise ValueError for a wrong shape, which C cannot check."""
    array = np.ascontiguousarray(values, dtype=float)
    if array.shape != shape:
        raise ValueError(f"the reference gave {name} of shape {array.shape}, expected {shape}")
    return array


def _write(memory: Any, value: Any, count: int) -> None:  # noqa: ANN401 - the value may have any type
    """Write `value` as `count` numbers; write NaN if it cannot be converted."""
    if count == 1 and isinstance(value, float):
        memory[0] = value
        return
    try:
        # Fast path for a contiguous array of `count` doubles.
        memory[:] = value
    except (TypeError, ValueError):
        values = numbers(value, count)
        memory[:] = (np.full(count, np.nan) if values is None else values).data


def numbers(value: Any, count: int) -> FloatArray | None:  # noqa: ANN401 - whatever arrives
    """Convert `value` to a flat array of `count` numbers; return None if that is impossible."""
    try:
        flat = np.asarray(value, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError):
        return None
    return np.ascontiguousarray(flat) if len(flat) == count else None
