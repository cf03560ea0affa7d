"""What simulating a model costs: time per step and memory (P0, Table 3; P1, Table 5)."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.reproduce.experiments.odometry import predict_path
from diffdrive_mpc.bench.reproduce.study import CostStudy
from diffdrive_mpc.bench.timing import quiet_core
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.load import MODEL_NAMES, load_model
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.plants.open_loop import random_commands

_SEED = 0
_BYTES_PER_MB = 1e6


@dataclass(frozen=True)
class Cost:
    """Mean and standard deviation over runs.

    Attributes
    ----------
    order
        Number of states.
    time_per_step
        Of the processor [s].
    memory
        Most that a run held at a time beyond what was there before it [MB].
    """

    order: int
    time_per_step: tuple[float, float]
    memory: tuple[float, float]


def measure_cost(study: CostStudy, on_done: Callable[[], None] = lambda: None) -> dict[str, Cost]:
    """Simulate the shipped models from commands to poses, one after the other, on one core with one BLAS thread.

    The numbers in a model do not change what it costs. Time is processor time: on an idle machine it is the time that
    passes, and what else runs does not count. Memory is measured in runs of its own, since watching it takes time.

    Parameters
    ----------
    study
        How many runs of how many steps.
    on_done
        Called after each run.
    """
    dt = load_robot().sample_time
    commands = random_commands(_SEED, duration=study.steps * dt)
    models = {name: load_model(name).discretise(dt) for name in MODEL_NAMES}

    def run(model: DiscreteModel) -> None:
        predict_path(model, commands, np.zeros(3))

    took: dict[str, list[float]] = {name: [] for name in models}
    held: dict[str, list[float]] = {name: [] for name in models}
    with quiet_core():
        for model in models.values():
            run(model)
        for _ in range(study.runs):
            for name, model in models.items():
                began = time.thread_time()
                run(model)
                took[name].append((time.thread_time() - began) / study.steps)
            on_done()
        for _ in range(study.runs):
            for name, model in models.items():
                tracemalloc.start()
                run(model)
                held[name].append(tracemalloc.get_traced_memory()[1] / _BYTES_PER_MB)
                tracemalloc.stop()
            on_done()
    return {
        name: Cost(model.order, _mean_and_std(took[name]), _mean_and_std(held[name])) for name, model in models.items()
    }


def _mean_and_std(values: list[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values, ddof=1))
