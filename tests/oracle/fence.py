"""Fence: the stopping path, with braking from the next tick on, must stay inside the rectangle minus its margin."""

from __future__ import annotations

import copy
import math

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from oracle.estimator import StateEstimator

# Constants of mpc/config/core_thresholds.yaml.
_PLAY, _AT_REST = 0.02, 0.005


class FenceWatch:
    """Monitor that checks whether a robot stays inside its fence."""

    def __init__(self, config: ControllerConfig, reference: Reference | None) -> None:
        self.fence, self.limits, self.dt = config.fence, config.limits, config.sample_time
        start = np.zeros(3)
        if self.fence.frame == "start" and reference is not None:
            start = reference.sample([0.0]).pose[0]
        turn = complex(math.cos(start[2]), math.sin(start[2]))
        self.centre = complex(start[0], start[1]) + turn * complex(self.fence.x, self.fence.y)
        self.axis = turn * complex(math.cos(self.fence.heading), math.sin(self.fence.heading))
        self.allowed, self.left = math.inf, False

    def distance_outside(self, pose: FloatArray) -> float:
        """Compute the distance of a pose (3,) outside [m]; negative inside."""
        position = (complex(pose[0], pose[1]) - self.centre) / self.axis
        half = 0.5 * np.array([self.fence.length, self.fence.width]) - self.fence.margin
        return float((np.abs([position.real, position.imag]) - half).max())

    def path_to_rest(self, estimator: StateEstimator, last: FloatArray) -> list[FloatArray]:
        """Predict poses (3,) now and at each sample until rest: repeat the command `last` (2,) once, then brake."""
        commands, model = copy.deepcopy(estimator.commands), estimator.model
        belief = estimator.nodes[-1].posterior._replace(mean=estimator.estimate.mean)
        command = np.array(last)
        rate = self.dt * np.array([self.limits.v_braking, self.limits.omega_braking])
        path = [estimator.estimate.pose]
        while True:
            commands.append(command)
            belief = estimator.filter.predict(belief, commands.acting(0))
            path.append(estimator.filter.pose(belief.mean, 0.0))
            is_active = commands.everything[-commands.memory - 1 :].any()
            if not is_active and abs((model.C @ belief.mean[: model.order])[0]) < _AT_REST:
                return path
            command = np.sign(command) * np.maximum(np.abs(command) - rate, 0.0)

    def holds(self, estimator: StateEstimator, last: FloatArray) -> bool:
        """Return True if the robot can stop inside; a robot outside must not move further out."""
        if not self.fence.enabled or self.left:
            return not self.left
        path = [self.distance_outside(pose) for pose in self.path_to_rest(estimator, last)]
        self.allowed = min(self.allowed, max(0.0, path[0]))
        self.left = max(path) > (self.allowed + _PLAY if self.allowed > 0.0 else 0.0)
        return not self.left
