"""Define a model structure, fit its parameters to a log, and drive with the model.

The structure is a first-order lag with saturated acceleration, which no transfer function describes. It is defined as a
CasADi function.
"""

from pathlib import Path

import casadi as ca
import numpy as np
from scipy.optimize import least_squares

from diffdrive_mpc import Controller, NonlinearModel, Trajectory, load_config, make_plant, simulate

DT, MEMORY = 0.02, 4  # sample time [s], and dead time in samples


def structure(lag, limit, gain):
    """Build a model with lags [s], accelerations [m/s^2, rad/s^2] and gains of v and omega."""
    x, window = ca.SX.sym("x", 2), ca.SX.sym("window", 2 * MEMORY + 2)
    # `window` contains the last commands, oldest first.
    after = x + DT * limit * ca.tanh((gain * window[:2] - x) / (lag * limit))
    step = ca.Function("step", [x, window], [after], ["x", "window"], ["after"])
    output = ca.Function("output", [x], [x], ["x"], ["y"])
    return NonlinearModel("saturating", step, output, DT, memory=MEMORY)


def predict(parameters, commands):
    """Return the twist (n, 2) of the structure for commands (n, 2), from rest."""
    model = structure(*np.reshape(parameters, (3, 2)))
    sent = np.vstack([np.zeros((MEMORY, 2)), commands])
    windows = np.hstack([sent[i : i + len(commands)] for i in range(MEMORY + 1)])
    return model.step.mapaccum(len(commands))(np.zeros(2), windows.T).full().T


# 1. Record random steps of both commands, and the speeds measured by encoders and gyro. The base of the simulated robot
#    limits the accelerations.
Path("weak.yaml").write_text("{description: weak motors, base: {twist_slew: {v: 0.3, omega: 1.5}}}\n")
robot, draw = make_plant("mujoco:weak.yaml", seed=1, sample_time=DT), np.random.default_rng(0)
robot.reset(np.zeros(3))
commands = np.repeat(draw.uniform([-0.5, -1.5], [0.5, 1.5], (40, 2)), 50, axis=0)
twist = np.empty_like(commands)
for k, command in enumerate(commands):
    robot.advance(command)
    measured = robot.measure()
    twist[k] = measured.wheel_twist.value[0], measured.yaw_rate.value

# 2. Fit the parameters by least squares on the prediction error.
start = [0.1, 0.1, 2.0, 6.0, 1.0, 1.0]
fit = least_squares(lambda parameters: (predict(parameters, commands) - twist).ravel(), start, bounds=(0.01, 20.0))
print("lag {:.3f}, {:.3f} s; limit {:.2f} m/s^2, {:.2f} rad/s^2; gain {:.3f}, {:.3f}".format(*fit.x))

# 3. Drive with the model along a path with the maximum accelerations of the robot.
limits = load_config("sm", {"limits.v": 0.5, "limits.v_slew": 0.28, "limits.omega_slew": 1.4})
path = Trajectory.from_waypoints([(0, 0), (2, 0), (2, 1), (0, 1)], limits=limits)
for name, model in {"shipped": None, "own": structure(*fit.x.reshape(3, 2))}.items():
    controller = Controller(load_config("sm", {"sample_time": DT}), model=model)
    run = simulate(controller, make_plant("mujoco:weak.yaml", seed=7, sample_time=DT), path)
    print(f"{name}: position RMSE {1000 * run.metrics.position_rmse_m:.1f} mm")
