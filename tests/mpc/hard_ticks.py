"""Duration of a step with limits active everywhere.

    python tests/mpc/hard_ticks.py [DRIVE...] [--horizons N,..] [--methods auto,osqp,daqp]

Report the processor time of `Controller.step`, and how the ticks were solved, as a Markdown table: on drives of robots
that can hardly follow, cannot follow, and can follow their reference; `DRIVES` defines the drives. Set
OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from itertools import product
from typing import Any

import numpy as np

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate

DRIVES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "slow wheels": ("kinematic", "cane", {"horizon": 60, "limits.wheel_speed": 0.0562, "limits.omega_slew": 0.134}),
    "narrow corridor": ("ssm", "s", {"horizon": 60, "limits.wheel_speed": 0.1, "limits.corridor": 0.01}),
    "slow response": ("ssm", "s", {"horizon": 60, "limits.v": 0.5, "limits.v_slew": 0.02}),
    "tight": ("ssm", "tight", {"horizon": 30}),
    "as shipped": ("ssm", "s", {}),
}
"""Model, trajectory and changes of the configuration of each drive."""
HEAD = "| drive | N | method | ticks | p50 [ms] | p99 [ms] | max [ms] | systems | of bound | stopped | RMSE [m] | by |"


class TimedController(Controller):
    """Controller that stores the processor time [ms] and the operations of each step."""

    def step(self, *args: Any, **bounds: Any) -> Any:
        start = time.process_time()
        result = super().step(*args, **bounds)
        vars(self).setdefault("times", []).append(1e3 * (time.process_time() - start))
        vars(self).setdefault("operations", []).append(result.solver.operations)
        vars(self).setdefault("stopped", []).append(result.solver.status.startswith("stopped"))
        return result


def row(drive: str, horizon: int | None, method: str) -> list[str]:
    """Drive once; return the cells of the row below HEAD."""
    model, trajectory, changes = DRIVES[drive]
    config = load_config(model, changes | {"solver.method": method} | ({"horizon": horizon} if horizon else {}))
    controller = TimedController(config)
    run = simulate(controller, make_plant("model:ssm", seed=1), load_trajectory(trajectory))
    records = vars(controller)
    methods = ", ".join(f"{name} {count}" for name, count in Counter(run.solver_methods).most_common())
    durations = [f"{value:.2f}" for value in np.percentile(records["times"], (50, 99, 100))]
    share_used = f"{max(records['operations']) / controller.operations_bound:.3f}"
    cells = [drive, config.horizon, method, len(run.solver_methods), *durations]
    cells += [f"{np.nanmax(run.solver_iterations):.0f}", share_used, sum(records["stopped"])]
    return [str(cell) for cell in (*cells, f"{run.metrics.position_rmse_m:.4f}", methods)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drives", nargs="*", default=list(DRIVES))
    parser.add_argument("--horizons", default="", help="horizons that replace those of the drives")
    parser.add_argument("--methods", default="auto")
    options = parser.parse_args()
    horizons = [int(word) for word in options.horizons.split(",") if word] or [None]
    print(HEAD, "| --- | --- |" + " ---: |" * 10, sep="\n", flush=True)
    for drive, horizon, method in product(options.drives, horizons, options.methods.split(",")):
        print(f"| {' | '.join(row(drive, horizon, method))} |", flush=True)


if __name__ == "__main__":
    main()
