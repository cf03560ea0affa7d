"""Failing solves as reported by the packages of the solvers, and references without a plan."""

from __future__ import annotations

from types import SimpleNamespace

import daqp
import numpy as np
import osqp

from diffdrive_mpc.mpc import load_config

# A soft limit is active at every tick of a drive at 0.5 m/s, so every tick calls the backend.
ACTIVE_LIMIT = {"limits.predicted_v": 0.4, "solver.method": "daqp"}
BACKENDS = {name: ACTIVE_LIMIT | {"solver.method": name} for name in ("osqp", "daqp")}

_TICK = load_config("ssm").sample_time
_FLAGS = {
    "solved": (osqp.SolverStatus.OSQP_SOLVED, 1),
    "iteration limit": (osqp.SolverStatus.OSQP_MAX_ITER_REACHED, -4),
    "infeasible": (osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE, -1),
    "time limit": (osqp.SolverStatus.OSQP_TIME_LIMIT_REACHED, -7),
}


class FailingSolver:
    """Patch of both packages: while `failing`, solves return `outcome` with `garbage` as plan and multipliers.

    The garbage is stored as the next warm start as well. `solves` counts all solves.
    """

    def __init__(self, monkeypatch, outcome="iteration limit", garbage=2.1e9):
        self.failing, self.outcome, self.garbage, self.solves = False, outcome, garbage, 0
        monkeypatch.setattr(osqp.OSQP, "solve", self._osqp(osqp.OSQP.solve))
        solve = self._daqp(daqp.Model.solve)
        monkeypatch.setattr(daqp, "Model", type("Model", (daqp.Model,), {"solve": solve}))

    def during(self, ticks, change=lambda k, m: m):
        """Return a change for `ideal_robot.drive` that makes the solves of `ticks` fail."""

        def change_during(k, measurement):
            self.failing = k in ticks
            return change(k, measurement)

        return change_during

    def _osqp(self, solve):
        def failing_solve(solver, *args, **kwargs):
            self.solves += 1
            result = solve(solver, *args, **kwargs)
            if not self.failing:
                return result
            x, y = np.full_like(result.x, self.garbage), np.full_like(result.y, self.garbage)
            if np.isfinite(self.garbage):
                solver.warm_start(x=x, y=y)
            info = SimpleNamespace(status_val=_FLAGS[self.outcome][0], iter=7, prim_res=1.0, dual_res=1.0)
            return SimpleNamespace(x=x, y=y, info=info)

        return failing_solve

    def _daqp(self, solve):
        def failing_solve(model):
            self.solves += 1
            x, value, flag, info = solve(model)
            if not self.failing:
                return x, value, flag, info
            info = dict(info) | {"lam": np.full_like(info["lam"], self.garbage)}
            return np.full_like(x, self.garbage), value, _FLAGS[self.outcome][1], info

        return failing_solve


class CorruptedReference:
    """Reference with NaN from the next tick on while `is_corrupted`, so that no problem can be built.

    Only samples one tick apart, as used for a plan, are corrupted; samples for the search of a return path are valid.
    """

    def __init__(self, original):
        self.original, self.is_corrupted = original, False
        self.name, self.duration = original.name, original.duration

    def sample(self, times):
        result = self.original.sample(times)
        if self.is_corrupted and np.diff(times).max(initial=0.0) < 2 * _TICK:
            result.pose[1:] = np.nan
        return result
