"""Gymnasium environment of path tracking."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from diffdrive_mpc.bench.drive import plant_settings
from diffdrive_mpc.bench.peers import PeerStep
from diffdrive_mpc.bench.run_row import statistics_of
from diffdrive_mpc.models.errors import checked_number
from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.pose import ahead_and_left, wrap_angle
from diffdrive_mpc.models.two_sided import sides_of
from diffdrive_mpc.mpc import ControllerConfig, Trajectory, load_trajectory
from diffdrive_mpc.sim import make_plant
from diffdrive_mpc.sim.metrics.metrics import TIME_TOLERANCE
from diffdrive_mpc.sim.plants.plant import Plant, RobotLostError
from diffdrive_mpc.sim.recorder import Recorder

_SEEDS = 2**31


class TrackingEnv(gym.Env[FloatArray, FloatArray]):
    """Environment of path tracking on a simulated robot; build it with `make_env`.

    The observation (7 + 5 preview,) has, in this order:

    * x, y [m] and theta [rad] of the current reference, relative to the last measured pose;
    * the last measured v [m/s] of the encoders and yaw rate [rad/s] of the gyro;
    * the last command v [m/s], omega [rad/s];
    * for each of the next `preview` ticks, x, y [m] and theta [rad] of the reference, relative to the last measured
      pose, and v [m/s] and omega [rad/s] of the reference.
    """

    def __init__(
        self,
        trajectory: str | Path | Trajectory,
        config: ControllerConfig,
        plant_options: Mapping[str, Any],
        *,
        preview: int,
        max_error: float,
    ) -> None:
        if not (isinstance(preview, (int, np.integer)) and preview in range(201)):
            raise ValueError(f"make_env: preview = {preview!r}: give 0 to 200 ticks")
        if not 0.0 < checked_number("max_error", max_error, "give m") < math.inf:
            raise ValueError(f"make_env: max_error = {max_error}: give more than 0 m")
        self.reference = trajectory if isinstance(trajectory, Trajectory) else load_trajectory(trajectory, config)
        self._plant_options = {**plant_options, **plant_settings(config)}
        self._preview, self._max_error = np.arange(preview + 1) * config.sample_time, max_error
        self._ticks = math.ceil((self.reference.duration - TIME_TOLERANCE) / config.sample_time) + 1
        self._tick = self._ticks
        v, omega = (sides_of(limit) for limit in (config.limits.v, config.limits.omega))
        self.action_space = gym.spaces.Box(np.array([-v[1], -omega[1]]), np.array([v[0], omega[0]]), dtype=np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (7 + 5 * preview,), np.float64)
        self._plant: Plant = self._new_plant(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Start an episode with the robot at rest at the start of the reference; return observation and info."""
        super().reset(seed=seed, options=options)
        self._plant = self._new_plant(int(self.np_random.integers(_SEEDS)))
        start = self.reference.sample([0.0]).pose[0]
        self._plant.reset(start)
        self._record = Recorder(self._ticks, keep_plans=False)
        self._pose, self._readings, self._command = start.copy(), np.zeros(2), np.zeros(2)
        self._measurement, self._tick = self._measure(), 0
        return self._observation(), self._info()

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Send a command (2,), v [m/s] and omega [rad/s], for one tick.

        Returns observation, reward, True if the episode terminated, True if it was truncated, and info. Raises
        ValueError unless the command has two finite values, and RuntimeError before `reset` or after the end.
        """
        try:
            command = np.asarray(action, dtype=float)
        except (TypeError, ValueError):
            command = np.empty(0)
        if command.shape != (2,) or not np.isfinite(command).all():
            shown = np.asarray(action).tolist()
            raise ValueError(f"action {shown}: give two finite numbers, v [m/s] and omega [rad/s]")
        if self._tick >= self._ticks:
            raise RuntimeError("no episode is running: call reset before step")
        self._command = np.clip(command, self.action_space.low, self.action_space.high)
        self._record.record_state(self._plant, self._measurement)
        self._record.record_step(PeerStep(self._command, "TRACKING", "", math.nan), self._command)
        ended = ""
        try:
            self._plant.advance(self._command)
        except RobotLostError as error:
            ended = str(error)
        self._record.record_work(self._plant, lost=bool(ended))
        self._tick += 1
        self._measurement = self._measure()
        info = self._info()
        if not ended and info["position_error"] > self._max_error:
            ended = f"{info['position_error']:.3g} m from the reference, max_error is {self._max_error:g} m"
        truncated = not ended and self._tick == self._ticks
        if ended or truncated:
            self._tick = self._ticks
            run = self._record.run(self._plant, self.reference, ended=ended)
            info |= {"metrics": statistics_of(run, timed=False), "ended": ended}
        return self._observation(), -info["position_error"], bool(ended), truncated, info

    def _new_plant(self, seed: int) -> Plant:
        return make_plant(**self._plant_options, seed=seed)

    def _measure(self) -> Measurement:
        """Read the sensors, and update the latest readings."""
        measurement = self._plant.measure()
        if measurement.pose is not None:
            self._pose = np.asarray(measurement.pose.value, dtype=float)
        if measurement.wheel_twist is not None:
            self._readings[0] = np.asarray(measurement.wheel_twist.value)[0]
        if measurement.yaw_rate is not None:
            self._readings[1] = float(np.asarray(measurement.yaw_rate.value))
        return measurement

    def _info(self) -> dict[str, Any]:
        expected = self.reference.sample([self._plant.time]).pose[0]
        error = float(np.hypot(*(self._plant.true_pose[:2] - expected[:2])))
        return {"time": self._plant.time, "position_error": error}

    def _observation(self) -> FloatArray:
        sample = self.reference.sample(self._plant.time + self._preview)
        difference = sample.pose - self._pose
        ahead, left = ahead_and_left(difference, self._pose[2])
        rows = np.column_stack([ahead, left, wrap_angle(difference[:, 2]), sample.twist])
        return np.concatenate([rows[0, :3], self._readings, self._command, rows[1:].ravel()])
