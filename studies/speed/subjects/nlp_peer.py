"""CasADi's `nlpsol` with its bundled solvers IPOPT, fatrop and sqpmethod; see docs/results.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from studies.speed.subjects import SolveReport
from studies.speed.subjects.shooting import shooting_program


class NlpPeer:
    """Solver by multiple shooting for the whole problem; the initial guess is the last solution, shifted by one stage.

    Parameters
    ----------
    problem
        Fields of a `studies.speed.stage.StageProblem`.
    settings
        Name of the solver, `plugin`, and its `options`.
    folder
        Not used, because no code is generated.
    """

    def __init__(self, problem: dict[str, Any], settings: dict[str, Any], folder: Path) -> None:
        del folder
        self._program = shooting_program(problem)
        self._step = ca.Function.deserialize(problem["step"])
        options = {"print_time": False, "record_time": True, **settings["options"]}
        if settings["plugin"] == "fatrop":
            options |= {"structure_detection": "auto", "equality": self._program.equality}
        self._solver = ca.nlpsol("tracking", settings["plugin"], self._program.nlp, options)
        self._guess: dict[str, Any] = {}

    def reset(self, state: np.ndarray, parameters: np.ndarray) -> None:
        """Reset the solver; the initial guess follows the feed-forward."""
        commands, states = parameters[:-1, 4:6], [state]
        for u, p in zip(commands, parameters[:-1], strict=True):
            states.append(np.array(self._step(states[-1], u, p)).ravel())
        self._guess = {"x0": self._program.guess(np.array(states), commands)}

    def solve(self, state: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Compute the command (2,) for the first state and the parameters of all stages."""
        data = np.concatenate([state, parameters.ravel()])
        solution = self._solver(p=data, **self._guess, **self._program.bounds)
        x = np.array(solution["x"]).ravel()
        multipliers = {"lam_x0": solution["lam_x"], "lam_g0": solution["lam_g"]}
        self._guess = {"x0": self._program.shift(x), **multipliers}
        return self._program.command(x)

    def report(self) -> SolveReport:
        """Return the report of the last solve."""
        stats = self._solver.stats()
        return SolveReport(float(stats["t_wall_total"]), int(stats["iter_count"]), bool(stats["success"]))
