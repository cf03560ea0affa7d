"""Failing solves, as reported by the solvers' packages, and references for which no plan exists."""

from __future__ import annotations

from types import SimpleNamespace

import daqp
import numpy as np
import osqp

from diffdrive_mpc.mpc import load_config

# A soft limit presses at every tick of a drive at 0.5 m/s, and the backend is asked each time.
PRESSING = {"limits.predicted_v": 0.4, "solver.method": "daqp"}
BACKENDS = {name: PRESSING | {"solver.method": name} for name in ("osqp", "daqp")}

_TICK = load_config("ssm").sample_time
_FLAGS = {
    "solved": (osqp.SolverStatus.OSQP_SOLVED, 1),
    "iteration limit": (osqp.SolverStatus.OSQP_MAX_ITER_REACHED, -4),
    "infeasible": (osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE, -1),
}


class FailingSolver:
    """While `failing`, both packages give `outcome`, with `garbage` for a plan and multipliers, at every solve.

    They are left with that garbage for a warm start, too. `solves` counts all solves, failing or not.
    """

    def __init__(self, monkeypatch, outcome="iteration limit", garbage=2.1e9):
        self.failing, self.outcome, self.garbage, self.solves = False, outcome, garbage, 0
        monkeypatch.setattr(osqp.OSQP, "solve", self._osqp(osqp.OSQP.solve))
        solve = self._daqp(daqp.Model.solve)
        monkeypatch.setattr(daqp, "Model", type("Model", (daqp.Model,), {"solve": solve}))

    def during(self, ticks, change=lambda k, m: m):
        """Return a change for `ideal_robot.drive` that makes these ticks fail."""

        def change_during(k, measurement):
            self.failing = k in ticks
            return change(k, measurement)

        return change_during

    def _osqp(self, solve):
        def wrapped(solver, *args, **kwargs):
            self.solves += 1
            result = solve(solver, *args, **kwargs)
            if not self.failing:
                return result
            x, y = np.full_like(result.x, self.garbage), np.full_like(result.y, self.garbage)
            if np.isfinite(self.garbage):
                solver.warm_start(x=x, y=y)
            info = SimpleNamespace(status_val=_FLAGS[self.outcome][0], iter=7, prim_res=1.0, dual_res=1.0)
            return SimpleNamespace(x=x, y=y, info=info)

        return wrapped

    def _daqp(self, solve):
        def wrapped(model):
            self.solves += 1
            x, value, flag, info = solve(model)
            if not self.failing:
                return x, value, flag, info
            info = dict(info) | {"lam": np.full_like(info["lam"], self.garbage)}
            return np.full_like(x, self.garbage), value, _FLAGS[self.outcome][1], info

        return wrapped


class SpoiltReference:
    """A reference that is no number from the next tick on while it is `spoilt`: no problem can be made of it.

    Only where it is sampled tick by tick, as for a plan: who looks around in it for a way back sees it as it is.
    """

    def __init__(self, original):
        self.original, self.spoilt = original, False
        self.name, self.duration = original.name, original.duration

    def sample(self, times):
        result = self.original.sample(times)
        if self.spoilt and np.diff(times).max(initial=0.0) < 2 * _TICK:
            result.pose[1:] = np.nan
        return result
