"""Velocity errors of the two drive models of P2, of SM, and of predictions without a model.

P2: Ivanjko et al., Modelling of Mobile Robot Dynamics. The errors are means and maxima of open-loop simulations. The
data are drives of the simulated robot with changes of direction, and logs of real robots, which `real_logs.yaml`
divides into rows for fitting and for validation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Record, read_log
from diffdrive_mpc.models.output_error.experiment import twist_experiments
from diffdrive_mpc.models.output_error.validation import simulate_records
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc_extras.drives.drive_model import Kind
from diffdrive_mpc_extras.drives.fitting import DriveFit, fit_drive
from studies.open_loop import load_command_parameters, random_commands
from studies.reproduce.drives import record_drive
from studies.reproduce.published import DriveStudy, PaperFinding, Published, PublishedDriveErrors
from studies.reproduce.real_logs import divide, load_protocol

NO_MODEL, PHYSICAL, EXPERIMENTAL, SM = "no model", "physical", "experimental", "SM"
KINDS: Mapping[str, Kind] = {PHYSICAL: "drive_physical", EXPERIMENTAL: "drive_experimental"}
UNSMOOTHED = ", sharp"
"""Suffix of predictions without the smoothing that the fit of the parameters requires for its derivatives."""
TWIN = "simulated robot"
_SEEDS_PER_REPETITION, _FIRST_SEED = 1000, 500
"""Number of seeds of a repetition, and offset of the first seed of this part; other drives do not use these seeds."""


@dataclass(frozen=True)
class VelocityErrors:
    """Mean and maximum errors of v [mm/s] and of omega [degrees per second]."""

    v: tuple[float, float]
    omega: tuple[float, float]


@dataclass(frozen=True)
class DriveModelsResult:
    """Errors and parameters of all models for one source of data.

    Attributes
    ----------
    source
        Name of the source: the simulated robot or a log.
    repetition
        Number of the repetition for the simulated robot; 0 for a log.
    errors
        Errors by model.
    values
        Parameters of the v and omega channels by drive model, in the units of `extras/drives/settings.yaml`.
    dead_time
        Dead times of v and omega by drive model [s].
    at_bound
        Names of the parameters that are at a bound of the search, by drive model.
    """

    source: str
    repetition: int
    errors: Mapping[str, VelocityErrors]
    values: Mapping[str, tuple[dict[str, float], dict[str, float]]]
    dead_time: Mapping[str, tuple[float, float]]
    at_bound: Mapping[str, tuple[str, ...]]


def reversing_commands(study: DriveStudy, seed: int, *, smooth: bool) -> FloatArray:
    """Draw random set-points (K, 2) up to the speeds of P2's second data set, equally often forwards and backwards."""
    ranges = load_command_parameters().random
    ends = np.array([ranges.v_range, ranges.omega_range])
    middle, half_range = ends.mean(axis=1), np.diff(ends, axis=1)[:, 0] / 2
    max_twist = np.array([study.v, study.omega])
    return np.asarray((random_commands(seed, smooth, study.duration) - middle) / half_range * max_twist)


def twin_records(study: DriveStudy, repetition: int) -> tuple[list[Record], list[Record]]:
    """Simulate training and validation drives; their set-points are alternately smoothed and stepwise."""
    seed = _SEEDS_PER_REPETITION * repetition + _FIRST_SEED
    records = [
        record_drive(f"reversals, seed {seed + k}", seed + k, reversing_commands(study, seed + k, smooth=k % 2 == 0))
        for k in range(2 * study.drives)
    ]
    return records[: study.drives], records[study.drives :]


def compare_on_twin(study: DriveStudy, repetition: int) -> DriveModelsResult:
    """Fit and validate the models on drives of the simulated robot."""
    return compare(TWIN, repetition, *twin_records(study, repetition))


def compare_on_log(name: str, data: Path) -> DriveModelsResult:
    """Fit the models to the first rows of a log and validate them on the remaining rows.

    Raise ConfigError if the log is missing or unusable.
    """
    protocol = load_protocol()
    log = read_log(data / protocol.log(name).file, protocol.log(name).mapping)
    log.require_sound()
    return compare(name, 0, *divide(log.records, protocol.share))


def compare(source: str, repetition: int, train: Sequence[Record], held_out: Sequence[Record]) -> DriveModelsResult:
    """Fit the models to the records `train` and validate them on the records `held_out`."""
    fits = {name: fit_drive(kind, train) for name, kind in KINDS.items()}
    predictions = {NO_MODEL: [record.command for record in held_out]}
    for name, fit in fits.items():
        predictions[name] = fit.simulate(held_out)
        predictions[name + UNSMOOTHED] = fit.simulate(held_out, sharp=True)
    predictions[SM] = simulate_records(identify_sm(train).system, held_out)
    return DriveModelsResult(
        source,
        repetition,
        {name: velocity_errors(simulated, held_out) for name, simulated in predictions.items()},
        {name: fit.values for name, fit in fits.items()},
        {name: _dead_time(fit) for name, fit in fits.items()},
        {name: fit.at_bound for name, fit in fits.items()},
    )


def _dead_time(fit: DriveFit) -> tuple[float, float]:
    return fit.dead_samples[0] * fit.dt, fit.dead_samples[1] * fit.dt


def velocity_errors(simulated: Sequence[FloatArray], records: Sequence[Record]) -> VelocityErrors:
    """Compute the errors of simulated twists (K, 2), v [m/s] and omega [rad/s], at the measurements in the records."""
    units = (1e3, np.degrees(1.0))
    experiments = twist_experiments(records)
    pairs = []
    for row, unit in enumerate(units):
        deviations = np.concatenate(
            [
                unit * np.abs(y[:, row] - experiment.outputs[:, row])[experiment.counts[:, row]]
                for y, experiment in zip(simulated, experiments, strict=True)
            ]
        )
        pairs.append((float(deviations.mean()), float(deviations.max())))
    return VelocityErrors(*pairs)


def drive_model_tables(results: Sequence[DriveModelsResult], published: Published) -> list[Table]:
    """Tabulate the published and the measured errors, and the identified parameters."""
    paper = published.drive_models
    rows = [
        (f"P2, {data}", name, *(f"{value:.2f}" for value in (*errors.v, *errors.omega)))
        for data, models in paper.items()
        for name, errors in models.items()
    ]
    parameter_rows = []
    for source, group in _by_source(results).items():
        for name in group[0].errors:
            mean = np.mean([[*result.errors[name].v, *result.errors[name].omega] for result in group], axis=0)
            rows.append((source, name, *(f"{value:.2f}" for value in mean)))
        for name in KINDS:
            parameter_rows.append((source, name, *(_format_parameters(group, name, row) for row in (0, 1))))
    errors = Table(
        "Drive models",
        ("data", "model", "v, mean [mm/s]", "v, maximum [mm/s]", "omega, mean [deg/s]", "omega, maximum [deg/s]"),
        tuple(rows),
        text_columns=2,
        note="Published: P2, Tables 3 to 7, without gains and with omega of the wheels instead of the gyroscope. "
        "Logs: errors on the last 40 % of the rows. No model: the command is the prediction. "
        "'sharp': without smoothing, with unchanged parameters. Simulated robot: means over repetitions.",
    )
    parameters = Table(
        "Parameters of the drive models",
        ("data", "model", "v", "omega"),
        tuple(parameter_rows),
        text_columns=4,
        note="SI units, first repetition; the actuator lag is 1.1 ms as in the paper. *: at a bound of the search, so "
        "the data do not determine the parameter.",
    )
    return [errors, parameters]


def _format_parameters(group: Sequence[DriveModelsResult], name: str, row: int) -> str:
    first, channel = group[0], ("v", "omega")[row]
    entries = [f"dead time {first.dead_time[name][row]:.3f}"]
    for key, value in first.values[name][row].items():
        mark = "*" if f"{channel} {key}" in first.at_bound[name] else ""
        entries.append(f"{key.replace('_', ' ')} {value:.3g}{mark}")
    return ", ".join(entries)


def _by_source(results: Sequence[DriveModelsResult]) -> dict[str, list[DriveModelsResult]]:
    groups: dict[str, list[DriveModelsResult]] = {}
    for result in results:
        groups.setdefault(result.source, []).append(result)
    return groups


def drive_model_findings(results: Sequence[DriveModelsResult], published: Published) -> list[PaperFinding]:
    """Evaluate the findings of P2 for each repetition on the simulated robot and for each log."""
    data_set = published.drive_models["second data set"]
    findings = []
    for data_kind, group in (
        ("drives of the simulated robot", [result for result in results if result.repetition]),
        ("real logs", [result for result in results if not result.repetition]),
    ):
        if not group:
            continue
        for claim, better, worse in (
            ("both drive models predict v and omega better than no model", (PHYSICAL, EXPERIMENTAL), NO_MODEL),
            ("the experimental model predicts v and omega better than the physical model", (EXPERIMENTAL,), PHYSICAL),
            ("SM predicts v and omega better than the experimental model", (SM,), EXPERIMENTAL),
        ):
            holds = tuple(
                all(
                    result.errors[name].v[0] < result.errors[worse].v[0]
                    and result.errors[name].omega[0] < result.errors[worse].omega[0]
                    for name in better
                )
                for result in group
            )
            paper = "-" if SM in better else "; ".join(_mean_text(data_set[name]) for name in (*better, worse))
            measured = "; ".join(
                _mean_text(
                    VelocityErrors(
                        (float(np.mean([result.errors[name].v[0] for result in group])), 0.0),
                        (float(np.mean([result.errors[name].omega[0] for result in group])), 0.0),
                    )
                )
                for name in (*better, worse)
            )
            source = "ours" if SM in better else "P2, Tables 5 to 7"
            findings.append(PaperFinding(f"{claim} (mean error, {data_kind})", source, paper, measured, holds))
    return findings


def _mean_text(errors: VelocityErrors | PublishedDriveErrors) -> str:
    return f"{errors.v[0]:.2f} mm/s, {errors.omega[0]:.2f} deg/s"
