"""Open-loop properties of models (FIT and pose drift on the plant), compared with the tracking error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from pandas import DataFrame

from diffdrive_mpc.bench.case import DIMENSIONS, Case
from diffdrive_mpc.bench.controllers import controller_config
from diffdrive_mpc.bench.experiment import mean
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.run_row import model_name
from diffdrive_mpc.bench.runner import OnDone, run_tasks
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.validation import pooled_fit_percent
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import Controller
from diffdrive_mpc.sim import make_plant
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop, random_commands

EXCITATION_SEEDS = (2001, 2002)
"""Seeds of random set-points and noise of the validation drives; no model is identified from these drives."""
DRIFT_AFTER = 2.0
"""Duration of a free prediction of the pose [s], about three horizons."""
_MIN_PAIRS = 5
"""Minimum number of pairs of model and plant for a meaningful rank correlation."""


@dataclass(frozen=True)
class Property:
    """Open-loop properties of a model on a plant.

    Attributes
    ----------
    case
        Model, configuration and plant.
    fit_v, fit_omega
        FIT of a free run that uses only the commands [%].
    drift
        RMS of the position error after `DRIFT_AFTER` [m].
    """

    case: Case
    fit_v: float
    fit_omega: float
    drift: float

    @classmethod
    def measure(cls, case: Case) -> Property | None:
        """Measure the properties on the plant of `case`; return None if the model is not a VelocityModel."""
        from diffdrive_mpc.models.identification.fit.poses import pose_drift  # noqa: PLC0415 - loads slowly

        config = controller_config(case.model, case.config, case.overrides)
        model = Controller(config).model
        if not isinstance(model, VelocityModel):
            return None
        sampled, records, twists, outputs = model.discretise(config.sample_time), [], [], []
        for seed in EXCITATION_SEEDS:
            plant = make_plant(case.plant, case.surface, case.sensors, seed)
            drive = drive_open_loop(plant, random_commands(seed, sample_time=config.sample_time))
            records.append(Record(f"seed {seed}", 0.0, config.sample_time, drive.command, pose=drive.true_pose))
            twists.append(sampled.simulate(drive.command))
            outputs.append(drive.output)
        fit_v, fit_omega = (pooled_fit_percent([y[:, i] for y in outputs], [y[:, i] for y in twists]) for i in (0, 1))
        (drift,) = pose_drift(records, twists, horizons=[DRIFT_AFTER])
        return cls(case, fit_v, fit_omega, drift.position_rmse)


def measure_properties(cases: Sequence[Case], jobs: int, on_done: OnDone = lambda: None) -> list[Property]:
    """Measure each pair of model and plant in `cases` once."""
    pairs = dict.fromkeys(_property_case(case) for case in cases if case.controller not in PEERS)
    measured = run_tasks([partial(Property.measure, case) for case in pairs], jobs, on_done)
    return [row for row in measured if row is not None]


def _property_case(case: Case) -> Case:
    """Return the case with default values of dimensions and settings that do not affect the properties."""
    plain = {
        dimension.name: dimension.default
        for dimension in DIMENSIONS
        if dimension.name in ("trajectory", "seed", "scenario", "timing")
    }
    model_overrides = tuple(pair for pair in case.overrides if not pair[0].startswith("solver."))
    return replace(case, overrides=model_overrides, **plain)


def property_rows(properties: Sequence[Property], runs: DataFrame) -> list[dict[str, object]]:
    """Return the properties as plain values, with the tracking error of each model on its plant."""
    property_cases = [_property_case(case) for case in runs["case"]]
    return [
        {
            "model": measured.case.labels["model"],
            **{name: measured.case.labels[name] for name in ("plant", "surface", "sensors")},
            "fit_v_percent": measured.fit_v,
            "fit_omega_percent": measured.fit_omega,
            "drift_m": measured.drift,
            "position_rmse_m": mean(runs[[case == measured.case for case in property_cases]], "position_rmse_m"),
        }
        for measured in properties
    ]


def property_table(properties: Sequence[Property], runs: DataFrame) -> Table:
    """Tabulate FIT, drift and tracking error, and the correlation of FIT and drift with the tracking error."""
    rows = property_rows(properties, runs)
    cells = tuple(
        (
            model_name(str(row["model"])),
            ", ".join(str(row[name]) for name in ("plant", "surface", "sensors")),
            *(number(float(row[name]), 1) for name in ("fit_v_percent", "fit_omega_percent")),  # type: ignore[arg-type]
            *(number(1e3 * float(row[name]), 1) for name in ("drift_m", "position_rmse_m")),  # type: ignore[arg-type]
        )
        for row in rows
    )
    columns = (
        "model",
        "plant",
        "FIT v [%]",
        "FIT omega [%]",
        f"drift after {DRIFT_AFTER:g} s [mm]",
        "position RMSE [mm]",
    )
    note = (
        "FIT and drift: free runs that use only the commands, including dead time, over "
        f"{len(EXCITATION_SEEDS)} drives with random set-points; slip is not included. {describe_correlations(rows)}"
    )
    return Table("Which property of a model predicts tracking", columns, cells, text_columns=2, note=note)


def describe_correlations(rows: Sequence[dict[str, object]]) -> str:
    """Describe the rank correlation of each property with the tracking error, or that there are too few pairs."""
    if len(rows) < _MIN_PAIRS:
        return f"{len(rows)} pairs of model and plant are too few for a correlation with the tracking error."
    from scipy.stats import spearmanr  # noqa: PLC0415 - loads slowly

    error = [row["position_rmse_m"] for row in rows]
    names = {"fit_v_percent": "FIT of v", "fit_omega_percent": "FIT of omega", "drift_m": "drift"}
    correlations = [
        f"{shown} {spearmanr([row[name] for row in rows], error).statistic:+.2f}" for name, shown in names.items()
    ]
    return (
        f"Rank correlation with the position RMSE over {len(rows)} pairs of model and plant: {', '.join(correlations)}."
    )
