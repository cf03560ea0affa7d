"""Lower bound of the tracking error: a controller with exact knowledge of plant, pose and slip, without a time limit.

The controller solves the problem of the predictive controller (`mpc.problem`) with IPOPT to convergence at every tick.
It has the weights and hard limits of the configuration and a longer horizon. Its model is fitted to the plant, its
poses are true, and its prediction includes slip. Heading errors are relative to the heading at which a robot with
side-slip stays on the path. Soft limits are omitted, because they are not active on references within the limits.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import casadi as ca
import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.peers import PeerStep
from diffdrive_mpc.bench.peers.tracking_peer import nearest_command, slew_step
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference, ReferenceSample
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.problem.margin import with_increments
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from studies.tracking.known_plant import KnownPlant


class ClairvoyantSettings(StrictModel):
    """Horizon, disturbance filter and options of IPOPT; `clairvoyant.yaml` describes each setting."""

    horizon: Annotated[int, Field(ge=1)]
    disturbance_memory: Annotated[float, Field(ge=0, lt=1)]
    tolerance: Annotated[float, Field(gt=0)]
    max_iterations: Annotated[int, Field(ge=1)]


@cache
def load_clairvoyant_settings(path: Path | None = None) -> ClairvoyantSettings:
    """Load the settings from `path`, by default the built-in file; raise ConfigError if the file is invalid."""
    return load_checked(ClairvoyantSettings, path or Path(__file__).parent / "clairvoyant.yaml")


@dataclass(frozen=True)
class PlantState:
    """Pose, states of the velocity model, and disturbance at one tick.

    Attributes
    ----------
    pose
        Pose (3,) x [m], y [m], theta [rad]; theta differs by at most pi from the heading of the reference.
    state, past
        States (n,) of the velocity model, and past commands (memory, 2), oldest first.
    disturbance
        Part (2,) of v [m/s] and omega [rad/s] that the model does not explain; assumed constant in the prediction.
    """

    pose: FloatArray
    state: FloatArray
    past: FloatArray
    disturbance: FloatArray


class ClairvoyantProgram:
    """Nonlinear program with cost, weights and hard limits of `mpc.problem`, with side-slip, without soft limits.

    Parameters
    ----------
    plant
        Model and side-slip of the plant.
    config
        Weights, limits and sample time.
    settings
        Horizon, and options of IPOPT.
    """

    def __init__(self, plant: KnownPlant, config: ControllerConfig, settings: ClairvoyantSettings) -> None:
        self._plant, self._steps = plant, settings.horizon
        self._model = plant.model.discretise(config.sample_time)
        self._config = with_increments(config, self._model)
        options: dict[str, Any] = {
            "print_time": 0,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.tol": settings.tolerance,
            "ipopt.max_iter": settings.max_iterations,
            "ipopt.warm_start_init_point": "yes",
            "ipopt.mu_init": 1e-4,  # the initial guess is the previous solution, which is close to the optimum
        }
        self._solver = ca.nlpsol("clairvoyant", "ipopt", self._program(), options)
        N, n, limits = self._steps, self._model.order, config.limits
        unbounded, zeros = np.full((n + 3) * N, np.inf), np.zeros((n + 3) * N)
        box = np.concatenate([np.tile([limits.v, limits.omega], N), unbounded])
        slew = np.concatenate([np.tile(slew_step(limits, self._model.dt), N), zeros])
        self._bounds = {"lbx": -box, "ubx": box, "lbg": -slew, "ubg": slew}
        self.reset()

    def reset(self) -> None:
        """Discard the previous solution, which is otherwise the initial guess of the next solve."""
        self._last_solution: dict[str, FloatArray] | None = None

    def solve(self, plant_state: PlantState, reference: ReferenceSample, feed_forward: FloatArray) -> FloatArray:
        """Compute the optimal commands (N, 2).

        Parameters
        ----------
        plant_state
            State of the plant at the current tick.
        reference
            Reference at the samples 0 to N.
        feed_forward
            Commands (N, 2) from which deviations are penalised.

        Raises
        ------
        RuntimeError
            If IPOPT does not converge, so that the bound is unknown.
        """
        moving = np.abs(reference.twist[:, 0]) > metric_settings().moving_speed
        # Heading error at which a robot with side-slip moves along the tangent of the path.
        side_slip_angle = np.where(moving, self._plant.side_slip * reference.twist[:, 1], 0.0)
        data = [
            plant_state.pose,
            plant_state.state,
            plant_state.past.ravel(),
            plant_state.disturbance,
            np.column_stack([reference.pose, side_slip_angle]).ravel(),
            feed_forward.ravel(),
        ]
        initial_guess = self._last_solution or {"x0": self._cold_start(plant_state, reference, feed_forward)}
        solution = self._solver(p=np.concatenate(data), **initial_guess, **self._bounds)
        if not self._solver.stats()["success"]:
            raise RuntimeError(f"the solver of the bound did not converge: {self._solver.stats()['return_status']}")
        x = np.array(solution["x"]).ravel()
        self._last_solution = {"x0": self._shift(x)} | {
            name: np.array(solution[key]).ravel() for name, key in (("lam_x0", "lam_x"), ("lam_g0", "lam_g"))
        }
        return x[: 2 * self._steps].reshape(-1, 2)

    def _program(self) -> dict[str, ca.SX]:
        model, w, N, n = self._model, self._config.weights, self._steps, self._model.order
        U, X, P = ca.SX.sym("U", 2, N), ca.SX.sym("X", n, N), ca.SX.sym("P", 3, N)
        pose, state, past = ca.SX.sym("pose", 3), ca.SX.sym("state", n), ca.SX.sym("past", 2, model.memory)
        disturbance, reference = ca.SX.sym("disturbance", 2), ca.SX.sym("reference", 4, N + 1)
        feed_forward = ca.SX.sym("feed_forward", 2, N)
        commands, cost, defects, x, p = ca.horzcat(past, U), ca.SX(0), [], state, pose
        for k in range(N):
            columns = [model.memory + k - int(delay) for delay in model.delay]
            current_input = ca.vertcat(*(commands[row, column] for row, column in enumerate(columns)))
            previous_input = ca.vertcat(*(commands[row, column - 1] for row, column in enumerate(columns)))
            next_state = ca.DM(model.A) @ x + ca.DM(model.B0) @ current_input + ca.DM(model.B1) @ previous_input
            outputs = ca.DM(model.C) @ ca.horzcat(x, next_state)
            acceleration = (outputs[0, 1] - outputs[0, 0]) / model.dt
            next_pose = self._next_pose(p, ca.sum2(outputs) / 2 + disturbance, acceleration)
            defects += [X[:, k] - next_state, P[:, k] - next_pose]
            x, p = X[:, k], P[:, k]
            weights = np.array([w.along, w.across, w.heading]) * (w.terminal if k == N - 1 else 1.0)
            cost += ca.dot(weights, _path_errors(p, reference[:, k + 1]) ** 2) / 2
        increment = U - ca.horzcat(past[:, -1], U[:, :-1])
        cost += ca.dot(np.array([w.v, w.omega]), ca.sum2((U - feed_forward) ** 2)) / 2
        cost += ca.dot(np.array([w.v_increment, w.omega_increment]), ca.sum2(increment**2)) / 2
        return {
            "x": ca.veccat(U, X, P),
            "p": ca.veccat(pose, state, past, disturbance, reference, feed_forward),
            "f": cost,
            "g": ca.veccat(increment, *defects),
        }

    def _next_pose(self, pose: ca.SX, twist: ca.SX, acceleration: ca.SX) -> ca.SX:
        """Compute the pose one sample later by the exact arc of `models.pose`, with lateral speed."""
        v, omega, dt = twist[0], twist[1], self._model.dt
        lateral = omega * (self._plant.load_shift * acceleration - self._plant.side_slip * v)
        half = omega * dt / 2
        # The series of sin(x) / x is exact for the small rotations in a sample, and is also defined at zero.
        length = dt * (1 - half**2 / 6 * (1 - half**2 / 20))
        c, s = length * ca.cos(pose[2] + half), length * ca.sin(pose[2] + half)
        return pose + ca.vertcat(c * v - s * lateral, s * v + c * lateral, omega * dt)

    def _cold_start(self, plant_state: PlantState, reference: ReferenceSample, feed_forward: FloatArray) -> FloatArray:
        states = np.tile(plant_state.state, self._steps)
        return np.concatenate([feed_forward.ravel(), states, reference.pose[1:].ravel()])

    def _shift(self, x: FloatArray) -> FloatArray:
        """Shift a solution by one step and repeat the last step."""
        N, n = self._steps, self._model.order
        parts = [part.reshape(N, -1) for part in np.split(x, [2 * N, (2 + n) * N])]
        return np.concatenate([np.vstack([part[1:], part[-1:]]).ravel() for part in parts])


def _path_errors(pose: ca.SX, reference: ca.SX) -> ca.SX:
    """Compute the errors along and across the path, and the heading error relative to the side-slip angle."""
    error = pose - reference[:3]
    c, s = ca.cos(reference[2]), ca.sin(reference[2])
    return ca.vertcat(c * error[0] + s * error[1], c * error[1] - s * error[0], error[2] - reference[3])


class ClairvoyantController:
    """Controller that solves the problem with the model of the plant to convergence at every tick.

    The controller requires a pose without error and delay at every tick.

    Parameters
    ----------
    plant
        Model and side-slip of the plant.
    config
        Weights, limits and sample time.
    settings
        Horizon, disturbance filter and solver options; by default from the built-in file.
    """

    def __init__(
        self, plant: KnownPlant, config: ControllerConfig, settings: ClairvoyantSettings | None = None
    ) -> None:
        self._plant, self._config = plant, config
        self._settings = settings or load_clairvoyant_settings()
        self._model = plant.model.discretise(config.sample_time)
        self._inverse_gain = np.linalg.inv(plant.model.dc_gain)
        self._lag = np.maximum(plant.model.lag, 0.0)
        self._program = ClairvoyantProgram(plant, config, self._settings)
        self._reference: Reference | None = None

    def start(self, reference: Reference, t0: float) -> None:
        """Start tracking `reference` with the robot at rest; time 0 of the reference is `t0` [s]."""
        self._reference, self._t0 = reference, t0
        self._state, self._past = np.zeros(self._model.order), np.zeros((self._model.memory, 2))
        self._previous_pose: FloatArray | None = None
        self._mean_twist, self._disturbance = np.zeros(2), np.zeros(2)
        self._program.reset()

    def step(self, t: float, measurement: Measurement) -> PeerStep:
        """Compute the command for the tick at time `t` [s].

        Raises
        ------
        RuntimeError
            If `start` was not called.
        ValueError
            If the measurement has no pose at time `t`.
        """
        start_time = time.perf_counter()
        if self._reference is None:
            raise RuntimeError("call start(reference, t0) before step")
        if measurement.pose is None or abs(measurement.pose.time - t) > 1e-9:
            raise ValueError("the clairvoyant controller needs an undelayed pose at every tick: use --sensors perfect")
        pose = np.array(measurement.pose.value, dtype=float)
        reference_time = t - self._t0
        times = np.asarray(reference_time + self._config.sample_time * np.arange(self._settings.horizon + 1))
        sample = self._reference.sample(times)
        previous = self._past[-1]
        pose[2] += 2 * np.pi * np.round((sample.pose[0, 2] - pose[2]) / (2 * np.pi))
        self._update_disturbance(pose)
        plant_state = PlantState(pose, self._state, self._past, self._disturbance)
        plan = self._program.solve(plant_state, sample, self._feed_forward(times))
        command = nearest_command(plan[0], self._config.limits, self._config.sample_time, previous)
        finished = reference_time >= self._reference.duration
        self._advance_model(command)
        return PeerStep(command, "FINISHED" if finished else "TRACKING", "", time.perf_counter() - start_time)

    def _feed_forward(self, times: FloatArray) -> FloatArray:
        """Compute steady-state commands (N, 2) for the twist of the reference one lag later minus the disturbance."""
        assert self._reference is not None
        desired = np.column_stack(
            [self._reference.sample(times[:-1] + lag).twist[:, i] for i, lag in enumerate(self._lag)]
        )
        return np.asarray((desired - self._disturbance) @ self._inverse_gain.T)

    def _update_disturbance(self, pose: FloatArray) -> None:
        """Update the disturbance, the low-pass filtered difference between the mean twists of robot and model."""
        previous, self._previous_pose = self._previous_pose, pose
        if previous is None:
            return
        turn = pose[2] - previous[2]
        direction = previous[2] + turn / 2
        ahead = np.cos(direction) * (pose[0] - previous[0]) + np.sin(direction) * (pose[1] - previous[1])
        difference = np.array([ahead, turn]) / self._model.dt - self._mean_twist
        memory = self._settings.disturbance_memory
        self._disturbance = memory * self._disturbance + (1 - memory) * difference

    def _advance_model(self, command: FloatArray) -> None:
        """Advance the model by one sample with `command` (2,)."""
        model, start_output = self._model, self._model.C @ self._state
        (current_input,), (previous_input,) = model.effective_inputs(command[None], self._past)
        self._state = model.A @ self._state + model.B0 @ current_input + model.B1 @ previous_input
        self._past = np.vstack([self._past[1:], command])
        self._mean_twist = 0.5 * (start_output + model.C @ self._state)
