"""A velocity model that is a function: prediction, plans compared with IPOPT's, and benefit under saturation."""

import casadi as ca
import numpy as np
import pytest
from nonlinear_program import DT, EXACT, LAG, NO_SLIP, by_ipopt, converged, record, saturating, windowed
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
    """Robot that obeys a nonlinear model, with exact sensors."""

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
        before, self.line = self.twist, [*self.line, np.array(command)]
        window = np.concatenate(self.line[-self.model.memory - 1 :])
        self.state = np.array(self.model.step(self.state, window)).ravel()
        self.pose = integrate_pose(self.pose, *((before + self.twist) / 2), self.model.dt)
        self.k += 1


def test_the_saturating_lag_is_sampled_as_an_ode_solver_has_it():
    model, most = saturating(delay=1), np.array([0.9, 1.8])
    commands = np.zeros((60, 2))
    commands[5:] = [0.8, -1.5]
    output = model.simulate(commands)[:, 0]

    def rate(t, v):
        u = commands[max(0, int(np.floor(t / DT + 1e-9)) - 1), 0] if t >= DT else 0.0
        return most[0] * np.tanh((u - v) / (LAG[0] * most[0]))

    times = np.arange(60) * DT
    exact = solve_ivp(rate, (0, times[-1]), [0.0], t_eval=times, rtol=1e-9, atol=1e-11, max_step=DT / 4).y[0]
    assert output == pytest.approx(exact, abs=1e-5)
    assert np.diff(output).max() < most[0] * DT


def test_its_lag_is_that_of_its_linearisation():
    model = saturating(delay=2)
    # The area beside a step is added up by trapezoids, which a kink at its beginning makes too large by this.
    assert model.lag == pytest.approx(LAG + 2 * DT + DT**2 / (12 * LAG), abs=2e-5)
    assert model.dc_gain == pytest.approx(np.eye(2), abs=1e-9)


@pytest.mark.parametrize("ticks", [14, 110], ids=["speeding up", "steady"])
@pytest.mark.parametrize("name", MODELS)
def test_real_time_iterations_converge_to_ipopts_solution(name, ticks):
    model = MODELS[name]
    config = load_config("ssm", {"horizon": 15, "reentry.enabled": False} | NO_SLIP | EXACT)

    def make():
        return Controller(config, model=model)

    def nothing(controller, t):
        pass

    drive = record(make(), ExactRobot(model), CIRCLE, ticks, nothing)
    controller, result = converged(make, drive, CIRCLE, nothing)
    assert result.planned_commands == pytest.approx(by_ipopt(controller, model=model), abs=1e-6)


def test_a_linear_model_as_a_function_gives_the_commands_of_the_linear_one(monkeypatch):
    linear = load_model("ssm").with_extra_dead_time([0.03, 0.05])
    sampled = linear.discretise(DT)
    x, window = ca.SX.sym("x", sampled.order), ca.SX.sym("window", 2 * (sampled.memory + 1))
    newest = sampled.memory
    recent = ca.vertcat(*(window[2 * (newest - int(d)) + j] for j, d in enumerate(sampled.delay)))
    older = ca.vertcat(*(window[2 * (newest - int(d) - 1) + j] for j, d in enumerate(sampled.delay)))
    after = sampled.A @ x + sampled.B0 @ recent + sampled.B1 @ older
    step = ca.Function("step", [x, window], [after], ["x", "window"], ["after"])
    output = ca.Function("output", [x], [sampled.C @ x], ["x"], ["y"])
    # Of the same robot: the ratio of yaw rates of a model made in Python is less certain.
    model = NonlinearModel("ssm", step, output, DT, newest, provenance=linear.provenance)
    assert model.lag == pytest.approx(linear.lag, abs=5e-4)
    # What the trapezoids leave is no matter here.
    monkeypatch.setattr(NonlinearModel, "lag", linear.lag)
    fixed = {"compensation.delay": False, "weights.v_increment": 20.0, "weights.omega_increment": 15.0}
    controllers = [Controller(load_config("ssm", fixed), choice) for choice in (linear, model)]
    plant = make_plant("mujoco", seed=0)
    plant.reset(CIRCLE.sample([0.0]).pose[0])
    for controller in controllers:
        controller.start(CIRCLE, plant.time)
    for _ in range(200):
        measurement = plant.measure()
        first, second = (controller.step(plant.time, measurement) for controller in controllers)
        assert second.command == pytest.approx(first.command, abs=1e-9)
        plant.advance(first.command)


def test_where_saturation_acts_it_is_better_than_its_linearisation():
    """A robot whose acceleration saturates far below the slew of its commands, on a path that stops and goes."""
    model = saturating(most=(0.35, 0.9))
    A, B, C = np.diag(-1 / LAG), np.diag(1 / LAG), np.eye(2)
    linear = VelocityModel("linearised", "ssm", A, B, C, dead_time=np.full(2, 2 * DT))
    config, errors = load_config("ssm"), []
    for choice in (linear, model):
        robot, controller, square = ExactRobot(model), Controller(config, choice), load_trajectory("square")
        controller.start(square, 0.0)
        reference = square.sample(np.arange(600) * DT).pose
        off = []
        for k in range(600):
            off.append(np.hypot(*(robot.pose - reference[k])[:2]))
            robot.advance(controller.step(robot.time, robot.measure()).command)
        errors.append(np.sqrt(np.mean(np.square(off))))
    assert errors[1] < 0.9 * errors[0]


def test_it_drives_the_physics():
    run = simulate(Controller(load_config("ssm"), model=saturating()), make_plant("mujoco", seed=0), CIRCLE)
    assert run.metrics.position_rmse_m < 0.015
    assert set(run.modes) == {"TRACKING"}


def test_what_cannot_be_a_robots_model_is_refused_in_one_line():
    x, window = ca.SX.sym("x", 2), ca.SX.sym("window", 4)
    output = ca.Function("output", [x], [x], ["x"], ["y"])

    def model(after, memory=1):
        return NonlinearModel(
            "bad", ca.Function("step", [x, window], [after], ["x", "window"], ["a"]), output, DT, memory
        )

    for after, message in (
        (1.1 * x + window[2:], "unstable at rest"),
        (0.5 * x + window[2:] + 1.0, "rest at x = 0"),
        (0.5 * x, "gain 0 from v_ref"),
    ):
        with pytest.raises(ModelError, match=message):
            model(after)
    with pytest.raises(ModelError, match="step has 4 numbers in window, expected 6"):
        model(0.5 * x + window[2:], memory=2)
    with pytest.raises(ConfigError, match="set sample_time to that"):
        Controller(load_config("ssm"), model=saturating(dt=0.01))


def test_the_feed_forward_holds_a_speed_at_which_the_gain_is_another_than_at_rest():
    """For a robot at the reference's speed, the plan is the command that keeps it: no cost, no deviation."""
    model = windowed()
    config = load_config("ssm", {"reentry.enabled": False} | NO_SLIP | EXACT)
    controller, robot = Controller(config, model=model), ExactRobot(model)
    drive = record(controller, robot, CIRCLE, 250, lambda controller, t: None)
    wanted = CIRCLE.sample([249 * DT]).twist[0]
    held = 1.5 * np.arctanh(wanted / 1.5)
    assert drive.commands[-1] == pytest.approx(held, abs=1e-5)
    assert np.abs(held - wanted).min() > 0.01, "the gain at rest would not do"
