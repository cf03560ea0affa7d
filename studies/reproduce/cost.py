"""Costs of simulations of the models: time per step and memory (P0, Table 3; P1, Table 5), with findings and table."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.bench.timing import quiet_core
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.load import load_linear_model, load_model
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc_extras.networks.network import NETWORK
from studies.open_loop import random_commands
from studies.reproduce.drives import predict_path
from studies.reproduce.published import CostStudy, PaperFinding, Published, PublishedCost

_SEED = 0
_BYTES_PER_MB = 1e6
_ROUNDING = 1e-9
"""Relative standard deviation below which all runs have the same value [-]."""


SampledModel = DiscreteModel | NonlinearModel


@dataclass(frozen=True)
class Cost:
    """Costs of a model as means and standard deviations over runs.

    Attributes
    ----------
    order
        Number of states.
    simulation_time
        Processor time of a complete simulation: discretisation of the model and the number of steps in the paper [s].
    time_per_step
        Processor time of one step [s].
    memory
        Maximum additional memory of a run [MB].
    """

    order: int
    simulation_time: tuple[float, float]
    time_per_step: tuple[float, float]
    memory: tuple[float, float]


def measure_cost(study: CostStudy, on_progress: Callable[[], None] = lambda: None) -> dict[str, Cost]:
    """Measure time and memory of simulations of the built-in models, from commands to poses.

    The models run one after another on one core with one BLAS thread. The built-in parameters are used, because their
    values do not affect the computing time. Times are processor times, which exclude other programs. Memory is measured
    in separate runs, because its measurement slows down the simulation.

    Parameters
    ----------
    study
        Number of runs, and number of steps in a run.
    on_progress
        Function that is called after each run of all models.
    """
    dt = load_robot().sample_time
    commands = random_commands(_SEED, duration=study.steps * dt)
    factories: dict[str, Callable[[], SampledModel]] = {
        name: partial(load_linear_model(name).discretise, dt) for name in STRUCTURES if name in study.simulation_steps
    }
    network = load_model(NETWORK)
    assert isinstance(network, NonlinearModel)
    factories[NETWORK] = lambda: network
    models = {name: create() for name, create in factories.items()}
    inputs = {name: random_commands(_SEED, duration=steps * dt) for name, steps in study.simulation_steps.items()}

    def run(model: SampledModel) -> None:
        predict_path(model, commands, np.zeros(3))

    simulation_times: dict[str, list[float]] = {name: [] for name in models}
    step_times: dict[str, list[float]] = {name: [] for name in models}
    memory: dict[str, list[float]] = {name: [] for name in models}
    with quiet_core():
        for model in models.values():
            run(model)
        for _ in range(study.runs):
            for name, model in models.items():
                start = time.thread_time()
                run(model)
                step_times[name].append((time.thread_time() - start) / study.steps)
                start = time.thread_time()
                predict_path(factories[name](), inputs[name], np.zeros(3))
                simulation_times[name].append(time.thread_time() - start)
            on_progress()
        for _ in range(study.runs):
            for name, model in models.items():
                tracemalloc.start()
                run(model)
                memory[name].append(tracemalloc.get_traced_memory()[1] / _BYTES_PER_MB)
                tracemalloc.stop()
            on_progress()
    return {
        name: Cost(model.order, *(_mean_and_std(values[name]) for values in (simulation_times, step_times, memory)))
        for name, model in models.items()
    }


def _mean_and_std(values: list[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values, ddof=1))


def cost_findings(cost: Mapping[str, Cost], published: Published) -> list[PaperFinding]:
    """Compare ratios of mean costs with those of the papers; absolute times depend on the computer."""
    step_times = {name: entry.time_per_step[0] for name, entry in cost.items()}
    memory = {name: entry.memory[0] for name, entry in cost.items()}
    simulation_times = {name: entry.simulation_time[0] for name, entry in cost.items()}
    paper, rules = published.cost, published.rules
    return [
        PaperFinding(
            f"a simulation of SM takes less than {rules.max_time_ratio:g} of the time of a simulation of MBM",
            "P0, Table 3",
            f"{paper['sm'].simulation_time[0] / paper['mbm'].simulation_time[0]:.2f}",
            f"{simulation_times['sm'] / simulation_times['mbm']:.2f}",
            (simulation_times["sm"] < rules.max_time_ratio * simulation_times["mbm"],),
        ),
        PaperFinding(
            f"a step of SM takes less than {rules.max_time_ratio:g} of the time of a step of MBM",
            "P0, Table 3",
            f"{paper['sm'].time_per_step[0] / paper['mbm'].time_per_step[0]:.2f}",
            f"{step_times['sm'] / step_times['mbm']:.2f}",
            (step_times["sm"] < rules.max_time_ratio * step_times["mbm"],),
        ),
        PaperFinding(
            "a simulation of SM requires less memory than a simulation of MBM",
            "P0, Table 3",
            f"{paper['sm'].memory[0] / paper['mbm'].memory[0]:.2f}",
            f"{memory['sm'] / memory['mbm']:.2f}",
            (memory["sm"] < memory["mbm"],),
        ),
        PaperFinding(
            f"a step of SSM is more than {rules.min_speed_ratio:g} times as fast as a step of SM",
            "P0, Table 3 and P1, Table 5",
            f"{paper['sm'].time_per_step[0] / paper['ssm'].time_per_step[0]:.0f} times",
            f"{step_times['sm'] / step_times['ssm']:.1f} times",
            (step_times["sm"] > rules.min_speed_ratio * step_times["ssm"],),
        ),
        *([_network_finding(step_times, paper, rules.min_speed_ratio)] if NETWORK in step_times else []),
    ]


def _network_finding(times: Mapping[str, float], paper: Mapping[str, PublishedCost], ratio: float) -> PaperFinding:
    return PaperFinding(
        f"a step of SSM is more than {ratio:g} times as fast as a step of LSTM",
        "P1, Table 5",
        f"{paper[NETWORK].time_per_step[0] / paper['ssm'].time_per_step[0]:.0f} times",
        f"{times[NETWORK] / times['ssm']:.1f} times",
        (times[NETWORK] > ratio * times["ssm"],),
    )


def cost_table(cost: Mapping[str, Cost], published: Published) -> Table:
    """Tabulate means and standard deviations over runs, published and measured."""
    rows = []
    for name, measured in cost.items():
        paper = published.cost[name]
        cells = [_pair(paper.simulation_time, 1e3), _pair(measured.simulation_time, 1e3)]
        cells += [_pair(paper.time_per_step, 1e6), _pair(measured.time_per_step, 1e6)]
        cells += [_pair(paper.memory, 1e3), _pair(measured.memory, 1e3)]
        rows.append((name.upper(), str(measured.order), *cells))
    quantities = ("simulation [ms]", "time per step [us]", "memory [kB]")
    values = [column for quantity in quantities for column in (f"published {quantity}", quantity)]
    note = (
        "Mean ± standard deviation over runs. Published: P0, Table 3 (MBM and SM in Simulink; its Table 4 prints 32 MB "
        "and 5.3 MB instead of 0.032 and 0.0053 MB); P1, Table 5 (SSM and "
        "LSTM, whose windows are evaluated in one batch here). Ours: from commands "
        "to poses, one process, one BLAS thread, processor time; a simulation has the number of steps in the paper, "
        "and discretises the model first; memory is the peak."
    )
    return Table("Cost of a simulation", ("model", "states", *values), tuple(rows), note=note)


def _pair(values: tuple[float, float], factor: float) -> str:
    mean, deviation = (factor * value for value in values)
    # If all runs have the same value, the deviation is only the rounding error of the mean.
    return f"{mean:.3g} ± {deviation:.2g}" if deviation > _ROUNDING * mean else f"{mean:.3g} ± 0"
