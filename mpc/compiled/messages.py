"""Measurements as the C sources take them, and what they say of those that they reject."""

from __future__ import annotations

from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import Measurement, Stamped
from diffdrive_mpc.mpc.compiled.library import pointer
from diffdrive_mpc.mpc.config.schema import Estimator
from diffdrive_mpc.mpc.estimator import TOO_MANY
from diffdrive_mpc.mpc.measurement_check import numbers

# Layout of ddmpc_stamped in numbers of eight bytes: stamp, value (3), covariance (9), two flags of four bytes.
_STAMPED, _VALUE, _COVARIANCE, _FLAGS = 14, 1, 4, 26
# Layout of ddmpc_note in the same, and where their count begins in numbers of four bytes.
_NOTE, _MOST_NOTES = 3, 8
_COUNT = 2 * _NOTE * _MOST_NOTES
_WHEELS, _YAW_RATE, _POSE = range(3)
_NAMES = ("wheel speed", "yaw rate", "pose")
_NOT_NUMBERS = ("not 2 finite numbers", "not finite", "it is not three finite numbers")


class MeasurementBuffer:
    """Memory of one ddmpc_measurement."""

    def __init__(self) -> None:
        memory = np.zeros(3 * _STAMPED)
        self._numbers, self._flags = memory.data.cast("B").cast("d"), memory.data.cast("B").cast("i")
        self.address = pointer(memory)
        self._memory = memory

    def fill(self, measurement: Measurement) -> None:
        """Take over whatever arrived; what is not numbers becomes NaN."""
        self._fill(0, measurement.pose, 3)
        self._fill(1, measurement.wheel_twist, 2)
        self._fill(2, measurement.yaw_rate, 1)

    def _fill(self, place: int, stamped: Stamped | None, count: int) -> None:
        flags = 2 * _STAMPED * place + _FLAGS
        if stamped is None:
            self._flags[flags] = 0
            return
        begin = _STAMPED * place
        self._flags[flags] = 1
        self._write(begin, stamped.time, 1)
        self._write(begin + _VALUE, stamped.value, count)
        covariance = stamped.covariance
        self._flags[flags + 1] = int(covariance is not None)
        if covariance is not None:
            flat = covariance.reshape(-1) if isinstance(covariance, np.ndarray) else covariance
            self._write(begin + _COVARIANCE, flat, count * count)

    def _write(self, begin: int, value: Any, count: int) -> None:  # noqa: ANN401 - whatever arrives
        """`value` as `count` numbers; NaN if it is anything else."""
        if count == 1 and isinstance(value, float):
            self._numbers[begin] = value
            return
        try:
            # Quick, and right for nothing but so many doubles in a row.
            self._numbers[begin : begin + count] = value
        except (TypeError, ValueError):
            found = numbers(value, count)
            self._numbers[begin : begin + count] = (np.full(count, np.nan) if found is None else found).data


class NotesBuffer:
    """Memory of one ddmpc_notes."""

    def __init__(self, settings: Estimator) -> None:
        memory = np.zeros(_NOTE * _MOST_NOTES + 1)
        self._numbers, self._codes = memory.data.cast("B").cast("d"), memory.data.cast("B").cast("i")
        self._history = settings.history
        self.address = pointer(memory)
        self._memory = memory

    def sentences(self) -> list[str]:
        """One for each note."""
        return [self._sentence(note) for note in range(self._codes[_COUNT])]

    def _sentence(self, note: int) -> str:
        a, b = self._numbers[_NOTE * note], self._numbers[_NOTE * note + 1]
        subject, fault = self._codes[2 * _NOTE * note + 4], self._codes[2 * _NOTE * note + 5]
        pose = subject == _POSE
        reasons = (
            "",
            _NOT_NUMBERS[subject],
            "its covariance is not a possible 3 x 3 matrix" if pose else "its covariance is not a possible one",
            "its stamp is not a finite number",
            f"its stamp lies {a:.3f} s in the future",
            "its stamp is not newer than that of the one before",
            f"it is {a:.2f} s old; the history reaches back {self._history} s",
            f"{a:.3g} is more than {b:g}",
            f"it jumps by {a:.2f} m and {b:.2f} rad" if pose else f"it jumps from {a:.2f} to {b:.2f}",
            TOO_MANY,
        )
        return f"{_NAMES[subject]} rejected: {reasons[fault]}"
