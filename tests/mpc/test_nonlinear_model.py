"""Nonlinear velocity models: prediction, comparison of plans with IPOPT, and benefit under saturation."""

import casadi as ca
import numpy as np
import pytest
from nonlinear_program import (
    DT,
    EXACT,
    LAG,
    NO_SLIP,
    iterate_to_convergence,
    record,
    saturating,
    solve_with_ipopt,
    windowed,
)
from scipy.integrate import solve_ivp

from diffdrive_mpc import (
    ConfigError,
    Controller,
    Measurement,
    ModelError,
    NonlinearModel,
    Stamped,
    VelocityModel,
    integrate_pose,
    load_config,
    load_model,
    load_trajectory,
    make_plant,
    simulate,
)

CIRCLE = load_trajectory("circle")


MODELS = {"states": saturating(), "window": windowed()}


class ExactRobot:
    """Robot with the motion of a nonlinear model and exact sensors."""

    def __init__(self, model):
        self.model, self.k, self.state, self.pose = model, 0, np.zeros(model.order), np.zeros(3)
        self.line = [np.zeros(2)] * model.memory

    @property
    def time(self):
        return self.k * self.model.dt

    @property
    def twist(self):
        return np.array(self.model.output(self.state)).ravel()

    def measure(self):
        return Measurement(Stamped(self.pose.copy(), self.time), yaw_rate=Stamped(float(self.twist[1]), self.time))

    def advance(self, command):
        previous_twist, self.line = self.twist, [*self.line, np.array(command)]
        window = np.concatenate(self.line[-self.model.memory - 1 :])
        self.state = np.array(self.model.step(self.state, window)).ravel()
        self.pose = integrate_pose(self.pose, *((previous_twist + self.twist) / 2), self.model.dt)
        self.k += 1


def test_saturating_lag_equals_the_solution_of_an_ode_solver():
    model, max_rate = saturating(delay=1), np.array([0.9, 1.8])
    commands = np.zeros((60, 2))
    commands[5:] = [0.8, -1.5]
    output = model.simulate(commands)[:, 0]

    def rate(t, v):
        u = commands[max(0, int(np.floor(t / DT + 1e-9)) - 1), 0] if t >= DT else 0.0
        return max_rate[0] * np.tanh((u - v) / (LAG[0] * max_rate[0]))

    times = np.arange(60) * DT
    expected = solve_ivp(rate, (0, times[-1]), [0.0], t_eval=times, rtol=1e-9, atol=1e-11, max_step=DT / 4).y[0]
    assert output == pytest.approx(expected, abs=1e-5)
    assert np.diff(output).max() < max_rate[0] * DT


def test_lag_of_a_nonlinear_model_equals_the_lag_of_its_linearisation():
    model = saturating(delay=2)
    # Trapezoids overestimate the area above the step response by the last term, because of the kink at its start.
    assert model.lag == pytest.approx(LAG + 2 * DT + DT**2 / (12 * LAG), abs=2e-5)
    assert model.dc_gain == pytest.approx(np.eye(2), abs=1e-9)


@pytest.mark.parametrize("ticks", [14, 110], ids=["speeding up", "steady"])
@pytest.mark.parametrize("name", MODELS)
def test_real_time_iterations_converge_to_ipopts_solution(name, ticks):
    model = MODELS[name]
    config = load_config("ssm", {"horizon": 15, "reentry.enabled": False} | NO_SLIP | EXACT)

    def make():
        return Controller(config, model=model)

    def no_inputs(controller, t):
        pass

    drive = record(make(), ExactRobot(model), CIRCLE, ticks, no_inputs)
    controller, result = iterate_to_convergence(make, drive, CIRCLE, no_inputs)
    assert result.planned_commands == pytest.approx(solve_with_ipopt(controller, model=model), abs=1e-6)


def test_linear_model_as_a_function_gives_the_commands_of_the_linear_model(monkeypatch):
    linear = load_model("ssm").with_extra_dead_time([0.03, 0.05])
    sampled = linear.discretise(DT)
    x, window = ca.SX.sym("x", sampled.order), ca.SX.sym("window", 2 * (sampled.memory + 1))
    newest = sampled.memory
    recent = ca.vertcat(*(window[2 * (newest - int(d)) + j] for j, d in enumerate(sampled.delay)))
    older = ca.vertcat(*(window[2 * (newest - int(d) - 1) + j] for j, d in enumerate(sampled.delay)))
    next_state = sampled.A @ x + sampled.B0 @ recent + sampled.B1 @ older
    step = ca.Function("step", [x, window], [next_state], ["x", "window"], ["after"])
    output = ca.Function("output", [x], [sampled.C @ x], ["x"], ["y"])
    # With the provenance of the same robot; otherwise the ratio of yaw rates would be less certain.
    model = NonlinearModel("ssm", step, output, DT, newest, provenance=linear.provenance)
    assert model.lag == pytest.approx(linear.lag, abs=5e-4)
    # Exclude the error of the trapezoids from the comparison.
    monkeypatch.setattr(NonlinearModel, "lag", linear.lag)
    overrides = {"compensation.delay": False, "weights.v_increment": 20.0, "weights.omega_increment": 15.0}
    controllers = [Controller(load_config("ssm", overrides), choice) for choice in (linear, model)]
    plant = make_plant("mujoco", seed=0)
    plant.reset(CIRCLE.sample([0.0]).pose[0])
    for controller in controllers:
        controller.start(CIRCLE, plant.time)
    for _ in range(200):
        measurement = plant.measure()
        first, second = (controller.step(plant.time, measurement) for controller in controllers)
        assert second.command == pytest.approx(first.command, abs=1e-9)
        plant.advance(first.command)


def test_nonlinear_model_tracks_better_than_its_linearisation_under_saturation():
    """The acceleration of the robot saturates far below the slew of its commands, on a path with stops."""
    model = saturating(max_rate=(0.35, 0.9))
    A, B, C = np.diag(-1 / LAG), np.diag(1 / LAG), np.eye(2)
    linear = VelocityModel("linearised", "ssm", A, B, C, dead_time=np.full(2, 2 * DT))
    config, errors = load_config("ssm"), []
    for tracked_model in (linear, model):
        robot, controller, square = ExactRobot(model), Controller(config, tracked_model), load_trajectory("square")
        controller.start(square, 0.0)
        reference = square.sample(np.arange(600) * DT).pose
        distances = []
        for k in range(600):
            distances.append(np.hypot(*(robot.pose - reference[k])[:2]))
            robot.advance(controller.step(robot.time, robot.measure()).command)
        errors.append(np.sqrt(np.mean(np.square(distances))))
    assert errors[1] < 0.9 * errors[0]


def test_nonlinear_model_tracks_the_mujoco_robot():
    run = simulate(Controller(load_config("ssm"), model=saturating()), make_plant("mujoco", seed=0), CIRCLE)
    assert run.metrics.position_rmse_m < 0.015
    assert set(run.modes) == {"TRACKING"}


def test_invalid_model_functions_raise_error_in_one_line():
    x, window = ca.SX.sym("x", 2), ca.SX.sym("window", 4)
    output = ca.Function("output", [x], [x], ["x"], ["y"])

    def model(next_state, memory=1):
        return NonlinearModel(
            "bad", ca.Function("step", [x, window], [next_state], ["x", "window"], ["a"]), output, DT, memory
        )

    for next_state, message in (
        (1.1 * x + window[2:], "unstable at rest"),
        (0.5 * x + window[2:] + 1.0, "x = 0 must be the steady state"),
        (0.5 * x, "gain 0 from v_ref"),
    ):
        with pytest.raises(ModelError, match=message):
            model(next_state)
    with pytest.raises(ModelError, match="step has 4 numbers in window, expected 6"):
        model(0.5 * x + window[2:], memory=2)
    with pytest.raises(ConfigError, match="set sample_time to it"):
        Controller(load_config("ssm"), model=saturating(dt=0.01))


def test_feed_forward_holds_a_speed_with_a_gain_that_differs_from_rest():
    """At the speed of the reference, the plan is the steady command, with zero cost and deviation."""
    model = windowed()
    config = load_config("ssm", {"reentry.enabled": False} | NO_SLIP | EXACT)
    controller, robot = Controller(config, model=model), ExactRobot(model)
    drive = record(controller, robot, CIRCLE, 250, lambda controller, t: None)
    target = CIRCLE.sample([249 * DT]).twist[0]
    steady_command = 1.5 * np.arctanh(target / 1.5)
    assert drive.commands[-1] == pytest.approx(steady_command, abs=1e-5)
    assert np.abs(steady_command - target).min() > 0.01, "the gain at rest must differ"
