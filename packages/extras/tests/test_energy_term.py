"""Energy term of the cost: its residual, the plan that minimises it, and the energy of the simulated robot."""

import casadi as ca
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from ideal_robot import IdealRobot
from identification_parts import differences
from nonlinear_program import EXACT, NO_SLIP, iterate_to_convergence, record, solve_with_ipopt

from diffdrive_mpc import ConfigError, Controller, load_config, load_trajectory
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc_extras.energy.power_readings import run_energy
from diffdrive_mpc_extras.energy_term import energy_function, with_min_radius
from diffdrive_mpc_extras.turn_costs import load_turn_costs

COSTS = {surface: load_turn_costs(f"fsu_bot-{surface}") for surface in ("slippery", "default")}
RESIDUALS = {surface: energy_function(costs) for surface, costs in COSTS.items()}
ENERGY_TERM = {"energy.weight": 0.01, "energy.turn_costs": "fsu_bot-default"}
CURVE = time_segments(
    [Segment(v=0.4, omega=0.0, duration=1.0), Segment(v=0.4, omega=0.3, duration=4.0)],
    TrajectoryLimits.of_robot(),
    name="gentle",
)


@pytest.mark.parametrize("surface", COSTS)
def test_square_of_the_residual_is_the_weighted_turning_power(surface):
    """Compare outside the smoothed range around straight motion, 0.05 W and 0.02 rad/s."""
    for v in (0.0, 0.1, 0.4, -0.3, 0.8):
        omega = np.concatenate([-np.geomspace(0.1, 1.5, 30), np.geomspace(0.1, 1.5, 30)])
        power = COSTS[surface].power(np.column_stack([np.full(60, v), omega])) - COSTS[surface].power([[v, 0.0]])
        result = np.array([float(RESIDUALS[surface]([v, w], 0.25)) for w in omega])
        assert np.sign(result) == pytest.approx(np.sign(omega))
        assert result**2 / 0.25 == pytest.approx(power, rel=0.08, abs=0.25)


@given(
    v=st.floats(-1.0, 1.0),
    omega=st.floats(-2.0, 2.0),
    weight=st.floats(1e-6, 1.0),
    surface=st.sampled_from(sorted(COSTS)),
)
def test_residual_is_smooth_at_rest_and_in_straight_motion(v, omega, weight, surface):
    """Compare the gradient with central differences at all commands."""
    command, symbolic_weight = ca.SX.sym("command", 2), ca.SX.sym("weight")
    value = RESIDUALS[surface](command, symbolic_weight)
    gradient = ca.Function("g", [command, symbolic_weight], [ca.jacobian(value, command)])
    point = np.array([v, omega])
    exact = gradient(point, weight).full()
    assert np.isfinite(exact).all()
    slopes = differences(lambda command: RESIDUALS[surface](command, weight), point)
    assert exact == pytest.approx(slopes, abs=2e-3 * np.sqrt(weight) * 60)


def test_residual_is_zero_at_rest_and_in_straight_motion():
    for v in (0.0, 0.5, -0.5):
        assert float(RESIDUALS["default"]([v, 0.0], 1.0)) == 0.0


@pytest.mark.parametrize(("surface", "weight"), [("slippery", 0.01), ("default", 0.001)])
def test_real_time_iterations_with_the_energy_term_converge_to_the_ipopt_solution(surface, weight):
    """Compare the plan in the middle of a turn with IPOPT's solution for the same cost."""
    overrides = {"energy.turn_costs": f"fsu_bot-{surface}", "energy.weight": weight}
    # With smaller increment weights, Gauss-Newton steps oscillate because the term is strongly curved.
    overrides |= {"weights.v_increment": 20.0, "weights.omega_increment": 15.0}
    config = load_config("ssm", {"horizon": 12, "reentry.enabled": False} | NO_SLIP | EXACT | overrides)

    def make_controller():
        return Controller(config)

    controller = make_controller()
    robot = IdealRobot(controller._prediction.sampled, np.zeros(3))
    drive = record(controller, robot, CURVE, 120, lambda *_: None)
    converged, result = iterate_to_convergence(make_controller, drive, CURVE, lambda *_: None)
    plan = solve_with_ipopt(converged)
    plan_without_term = solve_with_ipopt(converged, load_config(config, {"energy.weight": 0.0}))
    assert np.abs(plan - plan_without_term).max() > 1e-3, "the term must change the plan"
    assert result.planned_commands == pytest.approx(plan, abs=1e-6)


def test_higher_weight_reduces_energy_and_increases_the_position_error():
    """Drive a square on the slippery surface."""
    results = {}
    for weight in (0.0, 0.003, 0.02, 0.1):
        overrides = {"energy.weight": weight, "energy.turn_costs": "fsu_bot-slippery"}
        controller = Controller(load_config("ssm", overrides))
        plant = make_plant("mujoco:fsu_bot", "slippery", seed=7)
        results[weight] = simulate(controller, plant, load_trajectory("square", timing="smooth"))
    energy = [run_energy(run).energy_j for run in results.values()]
    assert energy[0] > energy[1] > energy[2]
    assert results[0.1].metrics.position_rmse_m > 1.5 * results[0.02].metrics.position_rmse_m


def test_weight_is_a_stage_parameter_that_can_change_during_a_drive():
    controllers = [Controller(load_config("ssm", ENERGY_TERM | {"energy.weight": weight})) for weight in (0.01, 0.1)]
    controllers[0].set_parameters(energy=[0.1])
    commands = []
    for controller in controllers:
        robot = IdealRobot(controller._prediction.sampled, np.zeros(3))
        commands.append(record(controller, robot, CURVE, 90, lambda *_: None).commands)
    assert np.array(commands[0]) == pytest.approx(np.array(commands[1]), abs=0.0)


def test_min_radius_comes_from_the_turn_costs_unless_the_configuration_sets_it():
    settings = {"energy.turn_costs": "fsu_bot-default", "energy.use_min_radius": True}
    controller = Controller(load_config("ssm", settings))
    assert controller.config.limits.min_commanded_radius == COSTS["default"].least_radius() > 1.0
    explicit = load_config("ssm", settings | {"limits.min_commanded_radius": 0.9})
    assert with_min_radius(explicit).limits.min_commanded_radius == 0.9
    unlimited = load_config("ssm", settings | {"energy.turn_costs": "fsu_bot-slippery"})
    assert with_min_radius(unlimited).limits.min_commanded_radius is None


def test_invalid_turn_costs_raise_config_error(tmp_path):
    with pytest.raises(ConfigError, match=r"energy.*turn_costs: give a shipped name, such as fsu_bot-default"):
        load_config("ssm", {"energy.weight": 0.1})
    with pytest.raises(ConfigError, match="unknown turn costs 'nowhere'|nowhere"):
        Controller(load_config("ssm", ENERGY_TERM | {"energy.turn_costs": "nowhere"}))
    content = COSTS["default"].model_dump(mode="json")
    content["vehicle"]["torque_limit"] = 0.1  # N m, less than the drag of the drive train
    (tmp_path / "weak.yaml").write_text(yaml.safe_dump(content))
    config = load_config("ssm", {"energy.turn_costs": str(tmp_path / "weak.yaml"), "energy.use_min_radius": True})
    with pytest.raises(ConfigError, match="give a motor torque above the limit for every turn"):
        Controller(config)
