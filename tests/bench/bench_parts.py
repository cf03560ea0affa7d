"""Fast plant, and outcomes of short runs, for tests of the bench."""

from dataclasses import dataclass

import numpy as np
from loop_parts import ConstantTwist, KinematicPlant
from numpy.typing import ArrayLike
from pandas import DataFrame

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.bench.experiment import frame
from diffdrive_mpc.bench.run_row import RunOutcome
from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped, TrackingController
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.sim import Run, make_plant, simulate


@dataclass(frozen=True)
class Arc(ConstantTwist):
    """Reference with constant twist, by default a gentle curve."""

    v: float = 0.5
    omega: float = 0.3
    duration: float = 8.0
    name: str = "arc"


class DisplacedUnicycle(KinematicPlant):
    """Plant that follows commands immediately, starts off the reference, and reports its pose after `delay` ticks."""

    sample_time = 0.0202

    def __init__(self, offset: ArrayLike = (0.0, 0.0, 0.0), delay: int = 0) -> None:
        self._offset, self._delay = np.asarray(offset, dtype=float), delay
        self.reset([0.0, 0.0, 0.0])

    def reset(self, pose: ArrayLike) -> None:
        self.true_pose: FloatArray = np.asarray(pose, dtype=float) + self._offset
        self.true_twist: FloatArray = np.zeros(3)
        self.time = 0.0
        self._past = [Stamped(self.true_pose, (k - self._delay) * self.sample_time) for k in range(self._delay)]

    def measure(self) -> Measurement:
        self._past.append(Stamped(self.true_pose, self.time))
        return Measurement(pose=self._past[-1 - self._delay])


def check_return(peer: TrackingController) -> Run:
    """Check that a peer returns to an arc from a displaced start; return the run."""
    plant = make_plant("model:sm", surface="ideal", sensors="perfect")
    plant.reset = lambda pose: type(plant).reset(plant, [-0.05, 0.1, 0.1])
    run = simulate(peer, plant, Arc(duration=6.0))
    is_settled = run.counted & (run.time > 4.5)
    assert run.errors.position[0] > 0.1
    assert run.errors.position[is_settled].max() < 0.02
    return run


def check_square(peer: TrackingController, path: str = "square") -> None:
    """Check that a peer completes a path and stays near it."""
    run = simulate(peer, make_plant("model:sm", seed=0), load_trajectory(path))
    assert run.metrics.completed
    assert run.errors.position[run.counted].max() < 0.05
    assert set(run.modes[:-1]) <= {"TRACKING", "FINISHED"}


def quick_case(**changes: object) -> Case:
    """Build a case on the plant of the controller's model, without noise."""
    return Case(**{"plant": "model:ssm", "surface": "ideal", "sensors": "perfect", **changes})  # type: ignore[arg-type]


def rows(*outcomes: RunOutcome) -> DataFrame:
    return frame(outcome.row for outcome in outcomes)


def quick_outcome(**changes: object) -> RunOutcome:
    case = quick_case(**changes)
    return RunOutcome(case, run_case(case))
