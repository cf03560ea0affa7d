"""The condensed problem of a tick with user terms, compared with IPOPT on the same nonlinear program."""

import casadi as ca
import numpy as np
import pytest
from ideal_robot import IdealRobot
from nonlinear_program import EXACT, NO_SLIP, iterate_to_convergence, record, solve_with_ipopt

from diffdrive_mpc import Controller, Term, load_config, load_trajectory

CIRCLE = load_trajectory("circle")
HORIZON = 15
# Offset of the point to the left of the reference [m]; the point moves with the reference, so that the plan is steady.
LATERAL_OFFSET = 0.37
FAR = (10.0, 10.0)


def distance():
    pose, point = ca.SX.sym("pose", 3), ca.SX.sym("parameters", 2)
    return pose, point, ca.sqrt(ca.sumsqr(pose[:2] - point) + 1e-6)


def distance_limit(metres, scale=1.0):
    pose, point, d = distance()
    function = ca.Function("least", [pose, point], [scale * d], ["pose", "parameters"], ["d"])
    return Term("least", function, "soft", lower=scale * metres, defaults=FAR)


def push_residual(weight):
    pose, point, d = distance()
    value = np.sqrt(weight) * ca.fmax(0.4 - d, 0)
    return Term("pushed", ca.Function("pushed", [point, pose], [value], ["parameters", "pose"], ["r"]), defaults=FAR)


def all_inputs_residual():
    """Return a residual of all inputs, with three rows without physical meaning."""
    sizes = {"command": 2, "twist": 2, "reference": 4, "pose": 3}
    symbols = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    pose, twist, command, reference = (symbols[name] for name in ("pose", "twist", "command", "reference"))
    rows = [3 * (twist[1] - command[1]), 2 * twist[0] * (pose[2] - reference[3]), command[0] * twist[1]]
    return Term("all", ca.Function("all", list(symbols.values()), [ca.vertcat(*rows)], list(symbols), ["r"]))


def speed_and_distance_limits(low, high):
    """Return wheel speeds of a command and a distance in one soft term; some rows have no limit."""
    pose, point, d = distance()
    command = ca.SX.sym("command", 2)
    value = ca.vertcat(command[0] + 0.2 * command[1], command[0] - 0.2 * command[1], d)
    function = ca.Function("band", [pose, command, point], [value], ["pose", "command", "parameters"], ["x"])
    return Term("band", function, "soft", upper=[0.585, None, high], lower=[None, None, low], defaults=FAR)


# Terms and tolerance of the comparison [m/s, rad/s]; IPOPT smooths the kinks of exact penalties.
CASES = {
    "no terms": ((), 1e-9),
    "residual": ((push_residual(500.0),), 1e-8),
    "soft": ((distance_limit(0.4, 3.0),), 2e-5),
    "all inputs": ((all_inputs_residual(),), 1e-8),
    "several": ((all_inputs_residual(), speed_and_distance_limits(0.41, 0.5), push_residual(500.0)), 1e-5),
}
SHIPPED = {"free": {}, "limited": {"limits.predicted_omega": 0.42}}


@pytest.mark.parametrize("shipped", SHIPPED)
@pytest.mark.parametrize(("model", "case"), [*(("ssm", case) for case in CASES), ("mbm", "several")])
def test_real_time_iterations_with_terms_converge_to_ipopts_solution(model, case, shipped):
    terms, tolerance = CASES[case]
    overrides = {"horizon": HORIZON, "reentry.enabled": False} | NO_SLIP | EXACT | SHIPPED[shipped]
    config = load_config(model, overrides)

    def points(t):
        x, y, theta = CIRCLE.sample(t + config.sample_time * np.arange(HORIZON + 1)).pose.T
        return np.column_stack([x - LATERAL_OFFSET * np.sin(theta), y + LATERAL_OFFSET * np.cos(theta)])

    def set_points(controller, t):
        controller.set_parameters(**{term.name: points(t) for term in terms if term.parameters})

    def make():
        return Controller(config, terms=terms)

    controller = make()
    drive = record(controller, IdealRobot(controller._prediction.sampled, np.zeros(3)), CIRCLE, 160, set_points)
    converged, result = iterate_to_convergence(make, drive, CIRCLE, set_points)
    plan, plain_plan = solve_with_ipopt(converged, terms=terms), solve_with_ipopt(converged)
    assert result.planned_commands == pytest.approx(plan, abs=tolerance)
    assert result.solver.soft_limits == (shipped == "limited" or any(term.soft for term in terms))
    assert not terms or shipped == "limited" or np.abs(plan - plain_plan).max() > 100 * tolerance, "terms must act"
    # In a steady turn, one iteration per tick gives the same result.
    assert result.command == pytest.approx(drive.commands[-1], abs=2e-4)


@pytest.mark.parametrize(
    ("limit", "factor", "turn", "ticks"), [("min_commanded_radius", 1.1, 0.0, 60), ("min_turn_radius", 1.0, -0.2, 20)]
)
def test_rows_of_the_minimum_radii_converge_to_ipopts_solution_while_active(limit, factor, turn, ticks):
    """The circle is ten percent tighter than the minimum radius of commands, or the robot heads out of the circle."""
    radius = factor * CIRCLE.sample([3.0]).twist[0] @ [1.0, 0.0] / CIRCLE.sample([3.0]).twist[0, 1]
    overrides = {"horizon": HORIZON, "reentry.enabled": False, f"limits.{limit}": radius}
    config = load_config("ssm", overrides | NO_SLIP | EXACT)

    def make():
        return Controller(config)

    controller = make()
    robot = IdealRobot(controller._prediction.sampled, CIRCLE.sample([0.0]).pose[0] + [0.0, 0.0, turn])
    drive = record(controller, robot, CIRCLE, ticks, lambda *_: None)
    final, result = iterate_to_convergence(make, drive, CIRCLE, lambda *_: None)
    plan, relaxed = solve_with_ipopt(final), solve_with_ipopt(final, load_config(config, {f"limits.{limit}": None}))
    assert np.abs(plan - relaxed).max() > 1e-2, "the rows must be active"
    assert result.planned_commands == pytest.approx(plan, abs=2e-5)
    assert limit == "min_turn_radius" or (radius * np.abs(plan[:, 1]) <= plan[:, 0] + 1e-6).all()
