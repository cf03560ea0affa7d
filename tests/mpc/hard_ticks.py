"""Duration of a step with limits active everywhere, and cost of a stopped solve.

    python tests/mpc/hard_ticks.py [DRIVE...] [--horizons N,..] [--methods auto,osqp,daqp] [--bounds SHARE,..]

Report the processor time of `Controller.step`, and how the ticks were solved, as a Markdown table: on drives of robots
that can hardly follow, cannot follow, and can follow their reference; `DRIVES` defines the drives. `--bounds` compiles
the core with these shares of the operations after which a solve is stopped. Set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from itertools import product
from typing import Any

import numpy as np

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.mpc.core import library

DRIVES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "slow wheels": ("kinematic", "cane", {"horizon": 60, "limits.wheel_speed": 0.0562, "limits.omega_slew": 0.134}),
    "narrow corridor": ("ssm", "s", {"horizon": 60, "limits.wheel_speed": 0.1, "limits.corridor": 0.01}),
    "slow response": ("ssm", "s", {"horizon": 60, "limits.v": 0.5, "limits.v_slew": 0.02}),
    "tight": ("ssm", "tight", {"horizon": 30}),
    "as shipped": ("ssm", "s", {}),
}
"""Model, trajectory and changes of the configuration of each drive."""
BOUND_LINE = "return MOST_WORK * (p.start + p.factor);"
"""Line of the core that bounds the operations of a solve."""
HEAD = ("drive", "N", "method", "bound", "ticks", "p50 [ms]", "p99 [ms]", "worst [ms]", "systems", "of bound")
HEAD += ("stopped", "RMSE [m]", "by")


class TimedController(Controller):
    """Controller that stores the processor time [ms] and the operations of each step."""

    def step(self, *args: Any, **bounds: Any) -> Any:
        start = time.process_time()
        result = super().step(*args, **bounds)
        vars(self).setdefault("times", []).append(1e3 * (time.process_time() - start))
        vars(self).setdefault("operations", []).append(result.solver.operations)
        vars(self).setdefault("stopped", []).append(result.solver.status.startswith("stopped"))
        return result


def lower_bound(share: float) -> None:
    """Make new controllers use a core that stops a solve after this share of its operations."""
    texts, origin = CORE_TEXTS(), CORE_ORIGIN()
    if texts["active_set.c"].count(BOUND_LINE) != 1:
        raise SystemExit("mpc/core/active_set.c does not contain the expected line of the bound; update BOUND_LINE")
    lower = f"return (ddmpc_count)({share!r} * MOST_WORK * (double)(p.start + p.factor));"
    texts["active_set.c"] = texts["active_set.c"].replace(BOUND_LINE, lower)
    vars(library)["core_texts"] = lambda: texts
    vars(library)["core_origin"] = lambda: f"{origin}, {share!r} of the bound"
    library.load_core.cache_clear()
    library.load_functions.cache_clear()


CORE_TEXTS, CORE_ORIGIN = library.core_texts, library.core_origin


def row(drive: str, horizon: int | None, method: str, share: float) -> list[str]:
    """Drive once; return the table row with the columns of HEAD."""
    model, trajectory, changes = DRIVES[drive]
    config = load_config(model, changes | {"solver.method": method} | ({"horizon": horizon} if horizon else {}))
    controller = TimedController(config)
    run = simulate(controller, make_plant("model:ssm", seed=1), load_trajectory(trajectory))
    records = vars(controller)
    methods = ", ".join(f"{name} {count}" for name, count in Counter(run.solver_methods).most_common())
    durations = [f"{value:.2f}" for value in np.percentile(records["times"], (50, 99, 100))]
    share_used = f"{max(records['operations']) / controller.operations_bound:.3f}"
    cells = [drive, config.horizon, method, f"{share:g}", len(run.solver_methods), *durations]
    cells += [f"{np.nanmax(run.solver_iterations):.0f}", share_used, sum(records["stopped"])]
    return [str(cell) for cell in (*cells, f"{run.metrics.position_rmse_m:.4f}", methods)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drives", nargs="*", default=list(DRIVES))
    parser.add_argument("--horizons", default="", help="horizons that replace those of the drives")
    parser.add_argument("--methods", default="auto")
    parser.add_argument("--bounds", default="1")
    options = parser.parse_args()
    horizons = [int(word) for word in options.horizons.split(",") if word] or [None]
    print(f"| {' | '.join(HEAD)} |\n| --- | {' | '.join(['---:'] * (len(HEAD) - 2))} | --- |", flush=True)
    for bound in map(float, options.bounds.split(",")):
        if bound != 1.0:
            lower_bound(bound)
        for drive, horizon, method in product(options.drives, horizons, options.methods.split(",")):
            print(f"| {' | '.join(row(drive, horizon, method, bound))} |", flush=True)


if __name__ == "__main__":
    main()
