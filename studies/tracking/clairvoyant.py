"""A bound, not a controller to drive with: it knows the plant, its pose and its slip, and may think for long.

It solves the predictive controller's problem (`mpc.problem`) with IPOPT to convergence at every tick: the same weights
and hard limits, a longer horizon. The model is fitted to the plant itself, poses are true, slip is part of the
prediction, and heading errors count from the heading that holds the path under side-slip. Soft limits are left out:
they are not reached on references within the limits.
"""

from __future__ import annotations

import time

import numpy as np

from diffdrive_mpc.bench.peers import PeerStep
from diffdrive_mpc.bench.peers.tracking_peer import nearest_command
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from studies.tracking.clairvoyant_program import (
    ClairvoyantProgram,
    ClairvoyantSettings,
    Present,
    load_clairvoyant_settings,
)
from studies.tracking.known_plant import KnownPlant


class ClairvoyantController:
    """IPOPT to convergence at every tick, on the plant's own model; needs a pose without error or delay at each.

    Parameters
    ----------
    known
        What it knows of the plant.
    config
        Weights, limits and sample time.
    settings
        Horizon and solver; by default the shipped ones.
    """

    def __init__(
        self, known: KnownPlant, config: ControllerConfig, settings: ClairvoyantSettings | None = None
    ) -> None:
        self._known, self._config = known, config
        self._settings = settings or load_clairvoyant_settings()
        self._model = known.model.discretise(config.sample_time)
        self._inverse_gain = np.linalg.inv(known.model.dc_gain)
        self._lag = np.maximum(known.model.lag, 0.0)
        self._program = ClairvoyantProgram(known, config, self._settings)
        self._reference: Reference | None = None

    def start(self, reference: Reference, t0: float) -> None:
        """Begin to track `reference`, whose time 0 is `t0` [s], with a robot at rest."""
        self._reference, self._t0 = reference, t0
        self._state, self._past = np.zeros(self._model.order), np.zeros((self._model.memory, 2))
        self._last_pose: FloatArray | None = None
        self._mean, self._disturbance = np.zeros(2), np.zeros(2)
        self._program.reset()

    def step(self, t: float, measurement: Measurement) -> PeerStep:
        """Decide the command for the tick at time `t` [s].

        Raises
        ------
        RuntimeError
            If `start` was not called.
        ValueError
            If there is no pose of this very instant.
        """
        began = time.perf_counter()
        if self._reference is None:
            raise RuntimeError("call start(reference, t0) before step")
        if measurement.pose is None or abs(measurement.pose.time - t) > 1e-9:
            raise ValueError("the clairvoyant needs a pose of the present at every tick: use --sensors perfect")
        pose = np.array(measurement.pose.value, dtype=float)
        since_start = t - self._t0
        times = np.asarray(since_start + self._config.sample_time * np.arange(self._settings.horizon + 1))
        sample = self._reference.sample(times)
        last = self._past[-1]
        pose[2] += 2 * np.pi * np.round((sample.pose[0, 2] - pose[2]) / (2 * np.pi))
        self._observe(pose)
        here = Present(pose, self._state, self._past, self._disturbance)
        plan = self._program.solve(here, sample, self._feed_forward(times))
        command = nearest_command(plan[0], self._config.limits, self._config.sample_time, last)
        finished = since_start >= self._reference.duration
        self._send(command)
        return PeerStep(command, "FINISHED" if finished else "TRACKING", "", time.perf_counter() - began)

    def _feed_forward(self, times: FloatArray) -> FloatArray:
        """(N, 2) commands that keep the reference's twist in the steady state, one lag ahead, disturbance taken off."""
        assert self._reference is not None
        wanted = np.column_stack(
            [self._reference.sample(times[:-1] + lag).twist[:, i] for i, lag in enumerate(self._lag)]
        )
        return np.asarray((wanted - self._disturbance) @ self._inverse_gain.T)

    def _observe(self, pose: FloatArray) -> None:
        """What the model did not explain of the mean twist over the last sample, smoothed."""
        last, self._last_pose = self._last_pose, pose
        if last is None:
            return
        turn = pose[2] - last[2]
        direction = last[2] + turn / 2
        ahead = np.cos(direction) * (pose[0] - last[0]) + np.sin(direction) * (pose[1] - last[1])
        unexplained = np.array([ahead, turn]) / self._model.dt - self._mean
        memory = self._settings.disturbance_memory
        self._disturbance = memory * self._disturbance + (1 - memory) * unexplained

    def _send(self, command: FloatArray) -> None:
        """Advance the model under the commands sent."""
        model, before = self._model, self._model.C @ self._state
        (recent,), (older,) = model.effective_inputs(command[None], self._past)
        self._state = model.A @ self._state + model.B0 @ recent + model.B1 @ older
        self._past = np.vstack([self._past[1:], command])
        self._mean = 0.5 * (before + model.C @ self._state)
