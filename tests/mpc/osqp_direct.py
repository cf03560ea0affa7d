"""What `solver.method: osqp` costs beside OSQP called directly: `python tests/mpc/osqp_direct.py [DRIVE...]` prints it.

At each tick of a drive a second OSQP solves the same program as its own users would: update, warm start from its last
solution, solve; to the same tolerance, with the same kinds of soft limit. Processor time; set OMP_NUM_THREADS=1. The
error of the drive stands beside that with `solver.method: auto`.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
import osqp
from scipy import sparse

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.mpc.problem.constants import HARD_KINDS
from diffdrive_mpc.mpc.solver.backend import Program

DRIVES: dict[str, tuple[str, dict[str, Any]]] = {
    "as shipped": ("s", {}),
    "tight": ("tight", {"horizon": 30}),
    "slew": ("s", {"limits.v_slew": 0.3, "limits.omega_slew": 0.8}),
    "corridor": ("cane", {"limits.corridor": 0.005}),
}
"""Trajectory and changes of the configuration of each."""


class Direct:
    """OSQP with the hard limits and some kinds of soft ones, each with two slack variables a row."""

    def __init__(self, kinds: list[int], config: Any) -> None:
        self.kinds, self.config, self.steps = kinds, config, config.horizon
        self.solver, self.last = osqp.OSQP(), None

    def numbers(self, program: Program) -> dict[str, Any]:
        """The program as matrices of one pattern, ready for OSQP."""
        n, soft = 2 * self.steps, [kind for kind in self.kinds if kind >= HARD_KINDS]
        m, weights = len(soft) * self.steps, self.config.weights
        commands = np.eye(n)
        increments = commands - np.eye(n, k=-2)
        hard = np.concatenate([commands[0::2], commands[1::2], increments[0::2], increments[1::2]])
        A, P = np.zeros((len(hard) + 3 * m, n + 2 * m)), weights.soft_quadratic * np.eye(n + 2 * m)
        A[: len(hard), :n] = hard
        A[len(hard) :, n:] = np.concatenate([np.eye(m, 2 * m, k=m) - np.eye(m, 2 * m), np.eye(2 * m)])
        stored, upper = A != 0.0, np.eye(n + 2 * m, dtype=bool)
        rows = slice(len(hard), len(hard) + m)
        stored[rows, :n] = True
        A[rows, :n] = np.concatenate([np.zeros((0, n)), *(program.rows(kind) for kind in soft)])
        upper[:n, :n] = np.triu(np.ones((n, n), dtype=bool))
        P[:n, :n] = program.H
        bounds = (bound[self.kinds].reshape(-1) for bound in (program.lower, program.upper))
        lower, higher = (
            np.concatenate([bound, np.full(2 * m, end)]) for bound, end in zip(bounds, (0.0, np.inf), strict=True)
        )
        # Column by column, as compressed columns are stored.
        return {
            "patterns": (sparse.csc_matrix(upper.astype(float)), sparse.csc_matrix(stored.astype(float))),
            "Px": P.T[upper.T],
            "Ax": A.T[stored.T],
            "q": np.concatenate([program.g, np.full(2 * m, weights.soft)]),
            "l": lower,
            "u": higher,
        }

    def solve(self, program: Program) -> tuple[float, int]:
        """Processor time [s] and iterations of the solve; NaN for the first, which sets OSQP up."""
        numbers = self.numbers(program)
        patterns = numbers.pop("patterns")
        first = self.last is None
        if first:
            P, A = (pattern.copy() for pattern in patterns)
            P.data, A.data = numbers["Px"], numbers["Ax"]
            bounds, settings = (numbers["l"], numbers["u"]), self.config.solver.osqp.model_dump()
            self.solver.setup(P, numbers["q"], A, *bounds, verbose=False, adaptive_rho_interval=50, **settings)
        began = time.process_time()
        if not first:
            self.solver.update(**numbers)
            self.solver.warm_start(x=self.last.x, y=self.last.y)
        self.last = self.solver.solve(raise_error=False)
        return np.nan if first else time.process_time() - began, self.last.info.iter


class Compared(Controller):
    """Solves each program twice; `times` has a row for each tick: ours and direct [ms], iterations of both."""

    def _ask_backend(self, deadline: float | None) -> bool:
        rows, direct = (vars(self).setdefault(name, kind) for name, kind in (("times", []), ("direct", {})))
        kinds = sorted({*range(HARD_KINDS), *self.program.kinds})
        theirs, iterations = direct.setdefault(tuple(kinds), Direct(kinds, self.config)).solve(self.program)
        began = time.process_time()
        refused = super()._ask_backend(deadline)
        ours = time.process_time() - began
        rows.append((1e3 * ours, 1e3 * theirs, iterations))
        return refused


def rmse(run: Any) -> float:
    """Position RMSE [mm]."""
    return 1e3 * float(np.sqrt(np.mean(np.sum((run.true_pose - run.reference_pose)[:, :2] ** 2, axis=1))))


def main() -> None:
    print("drive       ticks  RMSE auto  osqp [mm]  ours p50    p99  direct p50    p99 [ms]  ratio  iterations  direct")
    for name in sys.argv[1:] or DRIVES:
        trajectory, changes = DRIVES[name]
        controller = Compared(load_config("ssm", {**changes, "solver.method": "osqp"}))
        auto = Controller(load_config("ssm", changes))
        runs = [
            simulate(one, make_plant("model:ssm", seed=1), load_trajectory(trajectory)) for one in (auto, controller)
        ]
        errors = [rmse(run) for run in runs]
        rows = np.array(vars(controller)["times"])
        kept = rows[np.isfinite(rows[:, 1])]
        (ours, direct), (slow, slow_direct) = np.percentile(kept[:, :2], (50, 99), axis=0)
        ratio = kept[:, 0].sum() / kept[:, 1].sum()
        print(
            f"{name:11} {len(rows):5} {errors[0]:10.2f} {errors[1]:10.2f} {ours:9.2f} {slow:6.2f} {direct:11.2f} "
            f"{slow_direct:6.2f} {ratio:11.2f} {np.mean(runs[1].solver_iterations):11.0f} {kept[:, 2].mean():7.0f}"
        )


if __name__ == "__main__":
    main()
