"""Ticks of an exported controller on the emulated microcontroller.

    python tests/app/hard_emulated_ticks.py [COUNT [SEED [STEPS]]]

Limits are so tight that the robot can by no means follow, and what is measured is drawn: the plan of one tick is
worth little to the next. Prints instructions and operations beside the bound. Needs arm-none-eabi-gcc and QEMU.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from diffdrive_mpc import Measurement, Stamped, load_config, load_trajectory
from diffdrive_mpc.models.interface import Reference
from diffdrive_mpc_extras.export.emulation import EmulatedController
from diffdrive_mpc_extras.export.library import Precision, export_controller
from diffdrive_mpc_extras.export.report import link_stm32f4

DEFAULTS = (100_000, 0, 15)
TIGHT = {"limits.wheel_speed": 0.1, "limits.corridor": 0.01, "limits.omega_slew": 0.5}
PROGRESS = 2000


def measured(rng: np.random.Generator, reference: Reference, start: float, t: float) -> Measurement:
    """A pose near the reference, and wheels and gyro that mean nothing; some ticks bring no pose."""
    pose = reference.sample([t - start]).pose[0] + rng.normal(size=3) * (0.05, 0.05, 0.2)
    spread = float(10 ** rng.uniform(-2, 0.3))
    return Measurement(
        pose=Stamped(pose, t) if rng.random() < 0.9 else None,
        wheel_twist=Stamped(spread * rng.normal(size=2), t),
        yaw_rate=Stamped(spread * rng.normal(), t),
    )


def main() -> None:
    count, seed, steps = (int(word) for word in (*sys.argv[1:], *DEFAULTS[len(sys.argv) - 1 :]))
    config, reference = load_config("ssm", TIGHT | {"horizon": steps}), load_trajectory("s")
    rng = np.random.default_rng(seed)
    rows, statuses, start = [], Counter(), 0.0
    with TemporaryDirectory() as name:
        folder, image = Path(name) / "c", Path(name) / "image"
        folder.mkdir()
        exported = export_controller(config, reference, folder, Precision.FLOAT)
        if not link_stm32f4(folder, image):
            sys.exit("arm-none-eabi-gcc is missing, or the program does not fit")
        with EmulatedController(image) as controller:
            tick = 0
            while tick < count:
                controller.start(reference, start)
                for k in range(min(math.floor(reference.duration / config.sample_time), count - tick)):
                    t = start + k * config.sample_time
                    controller.step(t, measured(rng, reference, start, t))
                    tick += 1
                    if tick % PROGRESS == 0:
                        print(f"{tick} of {count}", file=sys.stderr, flush=True)
                rows += [(reply.cycles, reply.operations) for reply in controller.replies]
                statuses.update(reply.status for reply in controller.replies)
                start += reference.duration + 1.0
    instructions, operations = np.array(rows).T
    worst, bound = int(operations.max()), exported.operations_bound
    print(f"{count} ticks of {steps} steps, seed {seed}")
    print(f"instructions: p50 {np.median(instructions):,.0f}, most {instructions.max():,.0f}")
    print(f"operations: most {worst:,}, bound {bound:,}, {bound / worst:.2f} times; statuses {dict(statuses)}")
    if worst > bound:
        sys.exit("the bound does not hold")


if __name__ == "__main__":
    main()
