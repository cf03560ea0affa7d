"""One iteration a tick against iterations to convergence: over whole drives, and tick by tick against IPOPT."""

from copy import deepcopy

import casadi as ca
import numpy as np
import pytest

from diffdrive_mpc.bench.studies.speed.closed_loop_cost import closed_loop_cost
from diffdrive_mpc.models import load_model
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory
from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.sim import make_plant, simulate

TIGHT = {"limits.v_slew": 0.6, "limits.omega_slew": 2.5, "limits.v": 0.6, "limits.omega": 1.2}


class Converged:
    """A way that repeats its iterations until the plan stands still."""

    def __init__(self, way):
        self.way = way

    def solve(self, tick, guess):
        for _ in range(30):
            solution = self.way.solve(tick, guess)
            if np.abs(solution.plan - guess).max() < 1e-9:
                break
            guess = solution.plan
        return solution

    def reset(self):
        self.way.reset()


class Remembering:
    """A way that keeps the ticks that it was given, and the commands that it found."""

    def __init__(self, way):
        self.way, self.ticks, self.commands = way, [], []

    def solve(self, tick, guess):
        solution = self.way.solve(tick, guess)
        self.ticks.append(deepcopy(tick))
        self.commands.append(solution.plan[0].copy())
        return solution

    def reset(self):
        self.way.reset()


def drive(trajectory, around, **overrides):
    """Drive the trajectory on the model's plant with the default sensors; returns run, controller and its way."""
    controller = Controller(load_config("ssm", {"horizon": 20, "solver.backend": "daqp"} | overrides))
    way = controller._planner._way = around(controller._planner._way)
    plant = make_plant("model:ssm", sensors="default", seed=1)
    return simulate(controller, plant, load_trajectory(trajectory)), controller, way


def cost(run, config):
    kept = run.counted
    twist = run.true_twist[kept][:, [0, 2]]
    return closed_loop_cost(run.true_pose[kept], twist, run.command[kept], run.reference, config, load_model("ssm"))


@pytest.mark.parametrize("trajectory", ["circle", "square", "s", "cane"])
def test_a_drive_costs_what_it_costs_with_iterations_to_convergence(trajectory):
    (run, controller, _), (converged, _, _) = (drive(trajectory, way) for way in (Remembering, Converged))
    assert cost(run, controller.config) == pytest.approx(cost(converged, controller.config), rel=0.01)


def test_that_holds_where_limits_are_active():
    (run, controller, _), (converged, _, _) = (drive("s", way, **TIGHT) for way in (Remembering, Converged))
    increments = np.abs(np.diff(run.command, axis=0))
    assert (increments[:, 0] > 0.6 * controller.config.sample_time * 0.999).mean() > 0.02, "limits must be active"
    assert cost(run, controller.config) == pytest.approx(cost(converged, controller.config), rel=0.01)


@pytest.mark.parametrize("trajectory", ["circle", "s"])
def test_in_steady_tracking_commands_are_those_of_ipopt(trajectory):
    _, controller, way = drive(trajectory, Remembering)
    problem = TrackingProblem(controller.config, controller.model.discretise(controller.config.sample_time))
    options = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    for k in range(100, len(way.ticks) - 100, 60):
        tick = way.ticks[k]
        program, bounds = problem.nonlinear_program(tick)
        solver = ca.nlpsol("reference", "ipopt", program, options)
        start = np.concatenate([tick.feed_forward.ravel(), np.zeros(10 * problem.steps)])
        best = np.array(solver(x0=start, **bounds)["x"]).ravel()[:2]
        assert solver.stats()["success"]
        assert way.commands[k] == pytest.approx(best, abs=1e-3)
