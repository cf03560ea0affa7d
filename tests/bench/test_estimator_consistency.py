"""How honest the estimator is about itself on the physics, with the controller in the loop.

The physics is not the filter's model, so no interval of chi-squared holds: the bounds are those of what was measured,
with a margin. The sensors sit near 1 but for the yaw rate of the wheels, which is expected with more doubt than it
deserves: the filter takes the wheels in first, and the gyro, taken in next, is in line. Stated deviations of x and y
are half too large: the squared errors are 0.45 of the variances.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from diffdrive_mpc.models.interface import Measurement, Reference
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory
from diffdrive_mpc.mpc.step_result import StepResult
from diffdrive_mpc.sim import make_plant, simulate

TRAJECTORIES = ["circle", "square", "s", "cane"]
MINUTE = Path(__file__).parents[2] / "studies" / "ros" / "minute.yaml"
SETTLED = 10
"""Ticks after which the first poses have been weighed."""


class Recorder:
    """Keeps what the controller believed at each tick."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self.steps: list[StepResult] = []

    def start(self, reference: Reference, t0: float) -> None:
        self._controller.start(reference, t0)

    def step(self, t: float, measurement: Measurement) -> StepResult:
        self.steps.append(self._controller.step(t, measurement))
        return self.steps[-1]


def normalised(model: str) -> tuple[dict[str, float], np.ndarray]:
    """Over the four trajectories: mean normalised innovation by sensor, and mean squared pose error over variance."""
    innovations: dict[str, list[float]] = {}
    errors = []
    for trajectory in TRAJECTORIES:
        controller = Recorder(Controller(load_config(model)))
        run = simulate(controller, make_plant("mujoco", seed=20), load_trajectory(trajectory))
        for step, true in zip(controller.steps[SETTLED:], run.true_pose[SETTLED:], strict=True):
            assert step.estimate is not None
            for sensor, value in step.estimate.innovations.items():
                innovations.setdefault(sensor, []).append(value)
            error = step.estimate.pose - true
            error[2] = wrap_angle(error[2])
            errors.append(np.square(error / step.estimate.pose_deviation))
    return {sensor: float(np.mean(values)) for sensor, values in innovations.items()}, np.mean(errors, axis=0)


@pytest.mark.parametrize("model", ["ssm", "sm"])
def test_on_the_physics_innovations_and_errors_are_about_as_large_as_the_estimator_expects(model: str) -> None:
    """In comments: the range over single runs with both models, four trajectories and seeds 20 to 24."""
    innovations, (x, y, heading) = normalised(model)
    assert 0.75 < innovations["pose"] < 1.2  # 0.83 to 0.97
    assert 0.35 < innovations["wheel_speed"] < 1.5  # 0.38 to 0.99
    assert 0.75 < innovations["yaw_rate"] < 2.0  # 0.89 to 1.84
    assert 0.05 < innovations["wheel_yaw_rate"] < 1.0  # means over trajectories at seed 20: 0.10 (SM), 0.51 (SSM)
    assert 0.3 < x < 1.0  # means over seeds: 0.43 to 0.47
    assert 0.3 < y < 1.0  # 0.45 to 0.49
    assert 0.5 < heading < 2.0  # 0.75 to 1.66


@pytest.mark.long
def test_on_a_circle_of_a_minute_the_estimate_does_not_wander() -> None:
    """A gain that the filter takes for better known than it is would drift by the lap, and the robot off its path."""
    controller = Recorder(Controller(load_config("ssm")))
    reference = load_trajectory(str(MINUTE))
    run = simulate(controller, make_plant("mujoco", seed=20), reference)
    lap = len(run.time) // 5
    gains = [step.estimate.slip.omega_gain for step in controller.steps[lap:] if step.estimate is not None]
    assert max(gains) - min(gains) < 0.1
    error = np.hypot(*(run.true_pose - run.reference_pose)[:, :2].T)
    assert np.sqrt(np.mean(error[-lap:] ** 2)) < 0.006  # that of the shipped trajectories
