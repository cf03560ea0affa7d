"""One run of the study reduced to the numbers that tables and figures need: thousands of whole runs fill the memory."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.bench.case import Case, label, run_case
from diffdrive_mpc.bench.controllers import controller_config
from diffdrive_mpc.bench.peers.clairvoyant import ClairvoyantController
from diffdrive_mpc.bench.peers.known_plant import know_plant
from diffdrive_mpc.bench.tracking.plan import BOUND
from diffdrive_mpc.bench.tracking.targets import load_targets
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.sim import Metrics, Run, make_plant, simulate
from diffdrive_mpc.sim.metrics.metrics import steady_arc_lateral, steady_arcs


@dataclass(frozen=True)
class Recovered:
    """How a run came back after its disturbance, as `sim.metrics.recovery.Recovery` defines it."""

    recovery_time_s: float = math.nan
    overshoot_m: float = math.nan
    command_energy_v: float = math.nan
    command_energy_omega: float = math.nan


@dataclass(frozen=True, eq=False)
class Row:
    """What is kept of a run.

    Attributes
    ----------
    case
        What was run.
    metrics
        Its statistics.
    arcs
        Mean lateral error of every steady arc [m].
    late_lateral_m
        Largest |lateral| after the first seconds; how many, `targets.yaml` says.
    recovered
        After a disturbance.
    time
        (n,) counted ticks [s].
    along, across
        (n,) position error against the reference at the same time, ahead of it and to the left of it [m].
    steady
        (n,) whether the tick belongs to a steady arc.
    """

    case: Case
    metrics: Metrics
    arcs: tuple[float, ...]
    late_lateral_m: float
    recovered: Recovered
    time: FloatArray
    along: FloatArray
    across: FloatArray
    steady: NDArray[np.bool_]

    def as_json(self) -> dict[str, object]:
        """Labels and numbers as plain values, without step times and series; what is not finite is None."""
        case = self.case
        values: dict[str, object] = {
            **case.labels,
            "scenario": label(case.scenario),
            "seed": case.seed,
            "set": dict(case.overrides),
            "late_lateral_m": self.late_lateral_m,
            "steady_arcs_m": list(self.arcs),
        }
        kept = {k: v for k, v in asdict(self.metrics).items() if "step_time" not in k and k != "deadline_misses"}
        return {name: _plain(value) for name, value in (values | kept | asdict(self.recovered)).items()}


def run_row(case: Case, trajectories: tuple[str, ...]) -> Row:
    """Run a case and reduce it.

    Parameters
    ----------
    case
        One of ours, or the bound.
    trajectories
        What the bound's knowledge of the plant is fitted on.
    """
    return reduce_run(case, _run_bound(case, trajectories) if case.controller == BOUND else run_case(case))


def reduce_run(case: Case, run: Run) -> Row:
    """Keep of `run` what the study needs."""
    counted = np.flatnonzero(run.counted)
    offset = (run.true_pose - run.reference_pose)[counted]
    theta = run.reference_pose[counted, 2]
    c, s = np.cos(theta), np.sin(theta)
    steady = np.zeros(len(run.time), dtype=bool)
    for ticks in steady_arcs(run):
        steady[ticks] = True
    late = counted[run.time[counted] >= load_targets().lateral_from]
    return Row(
        case=case,
        metrics=run.metrics,
        arcs=tuple(float(value) for value in steady_arc_lateral(run)),
        late_lateral_m=float(np.max(np.abs(run.errors.lateral[late]), initial=0.0)),
        recovered=_recovered(run),
        time=run.time[counted],
        along=c * offset[:, 0] + s * offset[:, 1],
        across=c * offset[:, 1] - s * offset[:, 0],
        steady=steady[counted],
    )


def _run_bound(case: Case, trajectories: tuple[str, ...]) -> Run:
    known = know_plant(case.plant, case.surface, trajectories)
    controller = ClairvoyantController(known, controller_config("ssm"))
    plant = make_plant(case.plant, surface=case.surface, sensors=case.sensors, seed=case.seed)
    return simulate(controller, plant, load_trajectory(case.trajectory))


def _recovered(run: Run) -> Recovered:
    figures = run.recovery
    return Recovered(**{field.name: float(getattr(figures, field.name)) for field in fields(Recovered)})


def _plain(value: object) -> object:
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
