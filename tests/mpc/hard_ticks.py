"""How long a step takes where limits press everywhere: `python tests/mpc/hard_ticks.py [DRIVE...]` prints it.

Processor time of `Controller.step`, and how the ticks were solved, on drives of robots that can hardly or by no means
follow, and on one that can. Set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from typing import Any

import numpy as np

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate

DRIVES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "slow wheels": ("kinematic", "cane", {"horizon": 60, "limits.wheel_speed": 0.0562, "limits.omega_slew": 0.134}),
    "narrow corridor": ("ssm", "s", {"horizon": 60, "limits.wheel_speed": 0.1, "limits.corridor": 0.01}),
    "slow answer": ("ssm", "s", {"horizon": 60, "limits.v": 0.5, "limits.v_slew": 0.02}),
    "tight": ("ssm", "tight", {"horizon": 30}),
    "as shipped": ("ssm", "s", {}),
}
"""Model, trajectory and changes of the configuration of each."""


class Timed(Controller):
    """Keeps the processor time of each step [ms]."""

    def step(self, *args: Any, **bounds: Any) -> Any:
        began = time.process_time()
        result = super().step(*args, **bounds)
        vars(self).setdefault("times", []).append(1e3 * (time.process_time() - began))
        vars(self).setdefault("operations", []).append(result.solver.operations)
        return result


def main() -> None:
    print(f"{'drive':16} {'ticks':>5} {'p50 [ms]':>9} {'p99':>7} {'worst':>7} {'systems':>8} {'of bound':>8}  by")
    for name in sys.argv[1:] or DRIVES:
        model, trajectory, changes = DRIVES[name]
        controller = Timed(load_config(model, changes))
        run = simulate(controller, make_plant("model:ssm", seed=1), load_trajectory(trajectory))
        p50, p99, worst = np.percentile(vars(controller)["times"], (50, 99, 100))
        methods = ", ".join(f"{method} {count}" for method, count in Counter(run.solver_methods).most_common())
        most = np.nanmax(run.solver_iterations)
        share = max(vars(controller)["operations"]) / controller.operations_bound
        times = f"{p50:9.2f} {p99:7.2f} {worst:7.2f}"
        print(f"{name:16} {len(run.solver_methods):5} {times} {most:8.0f} {share:8.2f}  {methods}")


if __name__ == "__main__":
    main()
