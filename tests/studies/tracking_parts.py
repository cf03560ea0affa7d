"""Rows of a tracking study that were never driven, and a study small enough to drive in a test."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.outcomes import SolverShares
from diffdrive_mpc.bench.study import write_report
from diffdrive_mpc.sim import Metrics
from diffdrive_mpc.sim.metrics.recovery import Recovery
from studies.tracking.outcome import ReducedOutcome, TrackingResults, collect
from studies.tracking.plan import BOUND, plan_study
from studies.tracking.settings import PARTS, load_study
from studies.tracking.study import TrackingStudy

TINY = """
models: [ssm]
trajectories: [cane]
targets: {seeds: [20], untuned_surfaces: [slippery], late_sensors: slam, scenarios: [none]}
ablation:
  models: [ssm]
  surfaces: [default]
  seeds: [20, 21]
  variants: {as shipped: {}, no side-slip: {compensation.side_slip: false}}
  drawn: [no side-slip, as shipped]
cross: {plants: [sm, ssm], seeds: [20]}
surfaces: {surfaces: [default], sensors: [default], seeds: [20]}
scenarios: {names: [none], trajectories: [cane], seeds: [20]}
bound: {surfaces: [default]}
"""


def tiny_study(folder: Path) -> Path:
    path = folder / "tiny.yaml"
    path.write_text(TINY, encoding="utf-8")
    return path


def case(**changes: object) -> Case:
    values: dict[str, object] = {
        "controller": "mpc",
        "model": "ssm",
        "trajectory": "circle",
        "plant": "mujoco",
        "surface": "default",
        "sensors": "default",
        "seed": 20,
    }
    return Case(**{**values, **changes})  # type: ignore[arg-type]


def metrics(**changes: float) -> Metrics:
    """Every error well inside every target."""
    values: dict[str, object] = {field.name: 0.001 for field in fields(Metrics)}
    values |= {
        "steps": 100,
        "completed": True,
        "stopped": False,
        "deadline_misses": 0,
        "fallbacks": 0,
        "in_band_percent": 100.0,
    }
    return Metrics(**{**values, **changes})  # type: ignore[arg-type]


def recovery(
    time: float = math.nan, overshoot: float = math.nan, energy_v: float = math.nan, energy_omega: float = math.nan
) -> Recovery:
    return Recovery(time, overshoot, 0.001, energy_v, energy_omega, 0.0, 0.0)


def row(
    of: Case,
    *,
    arcs: tuple[float, ...] = (0.001,),
    late_lateral_m: float = 0.01,
    recovered: Recovery | None = None,
    across: np.ndarray | None = None,
    **changes: float,
) -> ReducedOutcome:
    """A row of 100 ticks, of which the second half is a steady arc; 1 mm to the left by default."""
    n = 100
    return ReducedOutcome(
        case=of,
        metrics=metrics(**changes),
        arcs=arcs,
        late_lateral_m=late_lateral_m,
        shares=SolverShares(90.0, 10.0, 0.0, 0),
        recovery=recovered or recovery(1.0, 0.01, 3.0, 2.0),
        time=0.02 * np.arange(n),
        along=np.zeros(n),
        across=np.full(n, 0.001) if across is None else across,
        steady=np.arange(n) >= n // 2,
    )


META: dict[str, object] = {
    "machine": {"cpu": "c", "cores": 2, "os": "o", "python": "3", "packages": {"numpy": "2"}},
    "revision": "abc",
    "version": "1",
    "date": "2026-01-01",
    "wall_time_s": 1.0,
}


def made_up() -> TrackingResults:
    """A whole study of rows that were never driven: 8 mm for the bound's peers, 2 mm for the bound."""
    study = load_study(quick=True)
    plan = plan_study(study, PARTS)
    rows = [row(one, position_rmse_m=0.002 if one.controller == BOUND else 0.008) for one in plan.all]
    return collect(study, plan, rows)


def write_made_up(results: TrackingResults, folder: Path) -> None:
    study = TrackingStudy(results.study)
    report = study.report(results, 1.0)
    write_report(study, report, META | report.meta, folder)
