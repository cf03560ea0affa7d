"""One real-time iteration per tick compared with the solution of IPOPT."""

import casadi as ca
import numpy as np
import pytest

from diffdrive_mpc import Controller, casadi_problem, load_config, load_trajectory, make_plant


def test_commands_equal_ipopt_commands_after_the_start():
    controller = Controller(load_config("ssm", {"horizon": 12}))
    plant, reference = make_plant("model:ssm", sensors="default", seed=1), load_trajectory("s")
    plant.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, plant.time)
    ticks = []
    while plant.time < reference.duration:
        result = controller.step(plant.time, plant.measure())
        ticks.append((controller.problem_inputs(), result.planned_commands[0]))
        plant.advance(result.command)
    problem = casadi_problem(controller.config)
    options = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    solver = ca.nlpsol("reference", "ipopt", problem.nlp, options)
    for inputs, command in ticks[100:-100:60]:
        expected = np.array(solver(**problem.arguments(inputs))["x"]).ravel()[:2]
        assert solver.stats()["success"]
        assert command == pytest.approx(expected, abs=2e-3)
