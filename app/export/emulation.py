"""What one closed loop on the emulated microcontroller took, and how it tracked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from diffdrive_mpc.app.export.emulator import MACHINE, EmulatedController
from diffdrive_mpc.models.interface import Reference
from diffdrive_mpc.mpc import Controller, ControllerConfig
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.sim import make_plant, simulate

_PLANT, _SEED = "mujoco", 0
# What the commands are compared with: the same problem, solved to the end.
_EXACT = {"solver.tolerance": 1e-9, "solver.max_iterations": 100_000}


@dataclass(frozen=True)
class Emulation:
    """One drive along the whole reference, with the default sensors.

    Attributes
    ----------
    steps
        Ticks.
    instructions
        (steps,) of each step.
    iterations
        (steps,) of the active set; 0 where no limit is active.
    modes
        How often the controller was in each mode.
    position_rmse
        Against the true pose [m].
    difference
        Largest difference of a command to that of the Python controller for the same measurements [m/s, rad/s].
    """

    steps: int
    instructions: np.ndarray[tuple[int], np.dtype[np.float64]]
    iterations: np.ndarray[tuple[int], np.dtype[np.int64]]
    modes: dict[str, int]
    position_rmse: float
    difference: float

    def as_json(self) -> dict[str, object]:
        """For export.json."""
        p50, p95, p99 = np.percentile(self.instructions, [50, 95, 99]).round().tolist()
        return {
            "machine": f"qemu {MACHINE}",
            "plant": _PLANT,
            "seed": _SEED,
            "steps": self.steps,
            "instructions_p50": int(p50),
            "instructions_p95": int(p95),
            "instructions_p99": int(p99),
            "instructions_max": int(self.instructions.max()),
            "iterations_max": int(self.iterations.max()),
            "modes": self.modes,
            "position_rmse_m": self.position_rmse,
            "command_difference_max": self.difference,
        }


def emulate(
    image: Path, config: ControllerConfig, reference: Reference, on_tick: Callable[[int, int], None]
) -> Emulation:
    """Drive the MuJoCo robot along `reference` with the program `image`, and the Python controller beside it.

    Raises ConfigError if QEMU is not installed.
    """
    plant = make_plant(_PLANT, surface="default", sensors="default", seed=_SEED, sample_time=config.sample_time)
    with EmulatedController(image) as controller:
        run = simulate(controller, plant, reference, on_tick=on_tick)
        replies = controller.replies
    beside = Controller(replace_values(config, {"reentry.enabled": False, **_EXACT}))
    beside.start(reference, 0.0)
    commands = [
        beside.step(float(t), measurement).command for t, measurement in zip(run.time, run.measurements, strict=True)
    ]
    return Emulation(
        steps=len(replies),
        instructions=np.array([reply.cycles for reply in replies]),
        iterations=np.array([reply.iterations for reply in replies]),
        modes=dict(Counter(str(reply.mode) for reply in replies)),
        position_rmse=float(run.metrics.position_rmse_m),
        difference=float(np.abs(np.array(commands) - run.command).max()),
    )
