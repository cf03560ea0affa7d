"""Artificial rows of a tracking study, and a study small enough to run in a test."""

import math
from dataclasses import fields
from pathlib import Path

import numpy as np
from bench_parts import META
from pandas import DataFrame

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.experiment import frame
from diffdrive_mpc.bench.run_row import SolverShares, driver_name
from diffdrive_mpc.bench.spec import in_parts
from diffdrive_mpc.bench.study import write_report
from diffdrive_mpc.sim import Metrics
from diffdrive_mpc.sim.metrics.recovery import Recovery
from studies.tracking.measured import BOUND, MARGIN, is_plain
from studies.tracking.study import TrackingStudy, load_study

TINY = """
title: Tracking
vary: {model: [ssm], trajectory: [cane], seed: [20]}
variants: {as shipped: {}, no side-slip: {compensation.side_slip: false}}
parts:
  targets: [{surface: [default, slippery]}, {sensors: [slam]}]
  ablation: [{variant: [as shipped, no side-slip], seed: [20, 21]}]
  cross: [{plant: ["model:sm", "model:ssm"]}]
  surfaces: [{surface: [default]}]
  scenarios: [{scenario: [none]}]
  bound: [{controller: [clairvoyant], model: [none], sensors: [perfect], seed: [0]}]
"""


def tiny_study(folder: Path) -> Path:
    path = folder / "tiny.yaml"
    path.write_text(TINY, encoding="utf-8")
    return path


def case(**changes: object) -> Case:
    return Case(**{"seed": 20, **changes})  # type: ignore[arg-type]


def statistics(**changes: object) -> dict[str, object]:
    """Return statistics with every error well within every target."""
    values: dict[str, object] = {field.name: 0.001 for field in fields(Metrics)}
    values |= {
        "steps": 100,
        "completed": True,
        "stopped": False,
        "deadline_misses": 0,
        "fallbacks": 0,
        "in_band_percent": 100.0,
    }
    shares = SolverShares(90.0, 10.0, 0.0, 0)
    return values | {field.name: getattr(shares, field.name) for field in fields(SolverShares)} | changes


def recovery(
    time: float = math.nan, overshoot: float = math.nan, energy_v: float = math.nan, energy_omega: float = math.nan
) -> dict[str, float]:
    """Return the recovery columns of a row."""
    values = Recovery(time, overshoot, 0.001, energy_v, energy_omega, 0.0, 0.0)
    return {
        f"recovery_{field.name.removeprefix('recovery_')}": getattr(values, field.name) for field in fields(Recovery)
    }


def row(case: Case, *, arcs: tuple[float, ...] = (0.001,), across: np.ndarray | None = None, **changes: object) -> dict:
    """Build a row of 100 ticks whose second half is a steady arc; by default 1 mm to the left."""
    n = 100
    values = {
        "case": case,
        "driver": driver_name(case),
        **case.as_row(),
        **statistics(),
        **recovery(1.0, 0.01, 3.0, 2.0),
        "plain": is_plain(case),
        "arcs": np.array(arcs),
        "late_lateral_m": 0.01,
        "omega_change": 0.02,
        "margin": dict(case.overrides).get(MARGIN, "-"),
        "time": 0.02 * np.arange(n),
        "along": np.zeros(n),
        "across": np.full(n, 0.001) if across is None else across,
        "steady": np.arange(n) >= n // 2,
        "series": None,
    } | changes
    return values | {"lost": not values["completed"]}


def artificial_results() -> DataFrame:
    """Build a whole study of artificial rows: 8 mm, and 2 mm for the bound."""
    plan = load_study(quick=True).drives()
    cases = dict.fromkeys(drive.case for drives in plan.values() for drive in drives)
    rows = [row(case, position_rmse_m=0.002 if case.controller == BOUND else 0.008) for case in cases]
    return in_parts(frame(rows), plan)


def write_artificial_report(results: DataFrame, folder: Path) -> None:
    study = TrackingStudy(load_study(quick=True))
    report = study.report(results, 1.0)
    write_report(study, report, META | report.meta, folder)
