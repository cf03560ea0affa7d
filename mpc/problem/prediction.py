"""Prediction of v, omega and heading: constant matrices, since velocity is linear and heading linear in the inputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray


@dataclass(frozen=True)
class Prediction:
    """Maps from state, past commands and future commands to predicted twists.

    Commands are flattened step by step: (v_ref[0], omega_ref[0], v_ref[1], ...). Rows of the point matrices are
    v[0], omega[0], v[1], ...; those of the mean matrices are the arcs' mean twists, likewise interleaved.

    Attributes
    ----------
    horizon
        Number of steps N.
    from_state, from_past, from_plan
        (2 (N + 1), n), (2 (N + 1), 2 memory), (2 (N + 1), 2 N): twist at the samples 0 to N.
    mean_from_plan
        (2 N, 2 N): mean twist over each of the N arcs, from the plan.
    heading_from_plan
        (N + 1, 2 N): heading at the samples 0 to N relative to the first.
    """

    horizon: int
    from_state: FloatArray
    from_past: FloatArray
    from_plan: FloatArray
    mean_from_plan: FloatArray
    heading_from_plan: FloatArray


def build_prediction(model: DiscreteModel, horizon: int) -> Prediction:
    """Roll the model out over `horizon` steps.

    Raises
    ------
    ValueError
        If `horizon` is less than 1.
    """
    if horizon < 1:
        raise ValueError(f"horizon = {horizon}: at least one step is needed")
    memory, n = model.memory, model.order
    width = 2 * (memory + horizon)
    # State at each sample as a linear function of [x0, past commands, plan].
    state = np.hstack([np.eye(n), np.zeros((n, width))])
    twists = [model.C @ state]
    for k in range(horizon):
        state = model.A @ state
        for channel in (0, 1):
            newer = n + 2 * (memory + k - int(model.delay[channel])) + channel
            state[:, newer] += model.B0[:, channel]
            state[:, newer - 2] += model.B1[:, channel]
        twists.append(model.C @ state)
    whole = np.vstack(twists)
    from_plan = whole[:, n + 2 * memory :]
    mean = 0.5 * (from_plan[:-2] + from_plan[2:])
    heading = np.vstack([np.zeros(2 * horizon), np.cumsum(model.dt * mean[1::2], axis=0)])
    return Prediction(horizon, whole[:, :n], whole[:, n : n + 2 * memory], from_plan, mean, heading)
