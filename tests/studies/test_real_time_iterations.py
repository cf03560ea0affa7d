"""One iteration per tick against iterations to convergence over whole drives, and against IPOPT tick by tick."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from diffdrive_mpc import Controller, casadi_problem, load_config, load_trajectory, make_plant
from oracle.controller import OracleController
from oracle.solver import solve
from studies.speed.measure import closed_loop_cost

TIGHT = {"limits.v_slew": 0.6, "limits.omega_slew": 2.5, "limits.v": 0.6, "limits.omega": 1.2}


def solve_quickly(qp):
    """Find the oracle's solution with the soft limits that matter; the others are checked to be satisfied."""
    chosen = np.zeros(len(qp.soft_lower), dtype=bool)
    # The oracle's proof needs at least one limit.
    chosen[0] = True
    while True:
        rows = {name: getattr(qp, name)[chosen] for name in ("soft_rows", "soft_lower", "soft_upper")}
        solution = solve(replace(qp, **rows))
        values = qp.soft_rows @ solution.x
        missed = ((values > qp.soft_upper + 1e-12) | (values < qp.soft_lower - 1e-12)) & ~chosen
        if not missed.any():
            return solution
        chosen |= missed


class Converged(OracleController):
    """Oracle that repeats its iteration until the plan no longer changes."""

    iterations = 0

    def _plan(self, estimate, target):
        for _ in range(30):
            before = self.guess
            plan, status = super()._plan(estimate, target)
            assert status.usable
            self.iterations += 1
            if before is not None and np.abs(plan.commands - before).max() < 1e-9:
                break
            self.guess = plan.commands
        self.guess = np.vstack([plan.commands[1:], plan.commands[-1:]])
        return plan, status


@pytest.fixture
def converged_controller(monkeypatch):
    monkeypatch.setattr("oracle.controller.solve", solve_quickly)
    return Converged


def drive(trajectory, make, on_tick=None, seconds=np.inf, **overrides):
    """Return commands and cost of a drive along the trajectory, or its first seconds, with default sensors."""
    controller = make(load_config("ssm", {"horizon": 12} | overrides))
    plant, reference = make_plant("model:ssm", sensors="default", seed=1), load_trajectory(trajectory)
    plant.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, plant.time)
    rows = []
    while plant.time < min(reference.duration, seconds):
        result = controller.step(plant.time, plant.measure())
        if on_tick is not None:
            on_tick(controller, result)
        rows.append((plant.true_pose, plant.true_twist[[0, 2]], result.command))
        plant.advance(result.command)
    pose, twist, command = (np.array(part) for part in zip(*rows, strict=True))
    cost = closed_loop_cost(pose, twist, command, reference, controller.config, controller.model)
    return SimpleNamespace(command=command, cost=cost, controller=controller)


@pytest.mark.long
@pytest.mark.parametrize("trajectory", ["cane"])
def test_cost_of_a_drive_equals_that_of_iterations_to_convergence(trajectory, converged_controller):
    run, best = (drive(trajectory, make) for make in (Controller, converged_controller))
    assert best.controller.iterations > 2 * len(best.command), "the oracle must iterate"
    assert run.cost == pytest.approx(best.cost, rel=0.01)


@pytest.mark.long
def test_cost_with_active_limits_equals_that_of_iterations_to_convergence(converged_controller):
    run, best = (drive("s", make, seconds=6.0, **TIGHT) for make in (Controller, converged_controller))
    increments = np.abs(np.diff(run.command, axis=0))
    assert (increments[:, 0] > 0.6 * run.controller.config.sample_time * 0.999).mean() > 0.02, "limits must be active"
    assert run.cost == pytest.approx(best.cost, rel=0.01)


@pytest.mark.parametrize("trajectory", ["s"])
def test_steady_commands_equal_those_of_ipopt(trajectory):
    ticks = []

    def remember(controller, result):
        ticks.append((controller.problem_inputs(), result.planned_commands[0]))

    problem = casadi_problem(drive(trajectory, Controller, remember).controller.config)
    options = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    solver = ca.nlpsol("reference", "ipopt", problem.nlp, options)
    for inputs, command in ticks[100:-100:60]:
        best = np.array(solver(**problem.arguments(inputs))["x"]).ravel()[:2]
        assert solver.stats()["success"]
        assert command == pytest.approx(best, abs=2e-3)
