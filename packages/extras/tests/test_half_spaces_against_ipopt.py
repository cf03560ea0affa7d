"""One tick's condensed problem with half-spaces against IPOPT on the same nonlinear program."""

from types import SimpleNamespace

import numpy as np
import pytest
from ideal_robot import IdealRobot
from nonlinear_program import EXACT, NO_SLIP, NonlinearProgram, converged, linear_outputs, record

from diffdrive_mpc import Controller, load_config, load_trajectory
from diffdrive_mpc_extras.free_space import Surroundings
from diffdrive_mpc_extras.free_space.config import free_space_of

CIRCLE = load_trajectory("circle")
HORIZON = 15


def test_half_spaces_under_pressure_converge_to_the_solution_of_ipopt():
    """A wall next to the circle leaves less room than the footprint needs, so the rows of half-spaces are active."""
    overrides = {"horizon": HORIZON, "reentry.enabled": False} | NO_SLIP | EXACT
    free = {"free_space.enabled": True, "free_space.uncertainty_factor": 0.0, "free_space.swerve": 0.0}
    config = load_config("ssm", overrides | free)
    pose = CIRCLE.sample([160 * config.sample_time]).pose[0]
    side = np.array([np.sin(pose[2]), -np.cos(pose[2])])
    along = np.array([side[1], -side[0]])
    middle = pose[:2] + (0.2 + free_space_of(config).margin + 0.01 + 0.3) * side + 0.1 * along
    corners = [middle + x * along + y * side for x, y in ((-0.1, -0.3), (0.3, -0.3), (0.3, 0.3), (-0.1, 0.3))]

    def make():
        controller = Controller(config)
        # The check of the way to rest and the way round are not what is tried here.
        controller.feature("free_space")._keeper._sweep = lambda *_: SimpleNamespace(sample=-1, least=1.0)
        controller.feature("free_space")._keeper._find_way = lambda *_: ""
        controller.feature("free_space").set_obstacles(Surroundings([corners]))
        return controller

    tables = {}

    def recorded(controller):
        keeper = controller.feature("free_space")._keeper
        set_rows = keeper._set_rows

        def set_and_keep(t, guide):
            set_rows(t, guide)
            tables[t] = controller._tick.parameters.copy()

        keeper._set_rows = set_and_keep
        return controller

    controller = recorded(make())
    drive = record(controller, IdealRobot(controller._predicted.sampled, np.zeros(3)), CIRCLE, 160, lambda *_: None)

    def keep_rows(again, time):
        """The planes stay those of the drive: they are data of the problem, not part of it."""
        table = again._tick.parameters
        again.feature("free_space")._keeper._set_rows = lambda *_: table.__setitem__(slice(None), tables[time])

    result = converged(make, drive, CIRCLE, keep_rows)
    program = NonlinearProgram(controller, result, drive, CIRCLE, linear_outputs(controller._predicted.sampled))
    without = program.solve()
    parameters = tables[drive.times[-1]]
    for index, term in enumerate(controller._terms):
        program.add(term, parameters[:, 5 * index : 5 * index + 5])
    plan = program.solve()
    assert result.solver.soft_limits
    assert np.abs(plan - without).max() > 1e-3, "the planes must press"
    assert result.planned_commands == pytest.approx(plan, abs=2e-5)
