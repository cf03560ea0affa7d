"""An exported controller on QEMU's STM32F4, in closed loop over its serial line, with its instructions counted.

With `-icount shift=0` QEMU's clock goes on by a nanosecond with every instruction, and the processor's own SysTick
counts them; how many of its ticks a million instructions take, the program measures when it starts.
"""

from __future__ import annotations

import shutil
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from diffdrive_mpc.bench.export.frames import ANSWER_BYTES, Answer, read_answer, request_bytes
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference

MACHINE = "netduinoplus2"
"""QEMU's name of a board with an STM32F405, a Cortex-M4F."""
_EMULATOR = "qemu-system-arm"
_OPTIONS = f"-M {MACHINE} -nographic -monitor none -serial stdio -icount shift=0,sleep=off".split()


@dataclass(frozen=True, slots=True)
class EmulatedStep:
    """What one tick gave; satisfies `models.interface.ControlStep`."""

    command: FloatArray
    mode: str
    message: str
    step_time: float
    solver: None = None
    plan: None = None


class EmulatedController:
    """Drives the program in `image`; satisfies `models.interface.TrackingController`. The reference is its own table.

    Parameters
    ----------
    image
        The linked STM32F4 program.

    Raises
    ------
    models.checked_yaml.ConfigError
        If QEMU is not installed, or the program does not answer.
    """

    def __init__(self, image: Path) -> None:
        if shutil.which(_EMULATOR) is None:
            raise ConfigError(f"--emulate: {_EMULATOR} was not found; install qemu-system-arm")
        self._process = subprocess.Popen(
            [_EMULATOR, *_OPTIONS, "-kernel", str(image)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        self.answers: list[Answer] = []
        """Of every tick since the last start; `cycles` are instructions."""
        self._anew = True
        greeting = self._read(8)
        self._per_tick = 1e6 / float(memoryview(greeting).cast("d")[0])

    def __enter__(self) -> EmulatedController:
        """Itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        """End the emulator."""
        self._process.kill()
        self._process.communicate()

    def start(self, reference: Reference, t0: float) -> None:
        """Start anew at the next tick, whose time is that of the start."""
        del reference, t0
        self._anew, self.answers = True, []

    def step(self, t: float, measurement: Measurement) -> EmulatedStep:
        """Decide the command for the tick at `t` [s]; raises ConfigError if the program does not answer."""
        began = time.perf_counter()
        assert self._process.stdin is not None
        self._process.stdin.write(request_bytes(t, measurement, anew=self._anew))
        self._process.stdin.flush()
        self._anew = False
        answer = read_answer(self._read(ANSWER_BYTES))
        self.answers.append(answer._replace(cycles=answer.cycles * self._per_tick))
        return EmulatedStep(answer.command, answer.mode, "", time.perf_counter() - began)

    def _read(self, count: int) -> bytes:
        assert self._process.stdout is not None
        data = self._process.stdout.read(count)
        if len(data) < count:
            raise ConfigError(f"--emulate: the program on {_EMULATOR} does not answer")
        return data
