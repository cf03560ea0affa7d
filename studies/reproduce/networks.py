"""LSTM and SSM, identified from one long free drive, and the nine networks of P1's Table 2.

P1: Guffanti, Pavon, Sensors 2025, 25(18), 5821.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import twist_experiments
from diffdrive_mpc.models.output_error.validation import score
from diffdrive_mpc.models.structures.ssm import identify_ssm
from diffdrive_mpc_extras.networks.finding import simulate_records
from diffdrive_mpc_extras.networks.network import Architecture, fit_percent, rmse, split_windows, windows_of
from diffdrive_mpc_extras.networks.training import train, training_settings
from studies.reproduce.drives import QUANTITIES, STATISTICS, RobotLogs, dead_reckon, discretise, pose_error
from studies.reproduce.published import NetworkStudy, PaperFinding, Published, PublishedNetwork, as_flags
from studies.reproduce.state_space import FIT_COLUMNS, PAPERS_ORDER, FreeDrive, VelocityFit, free_drive

MEASURED, SSM, LSTM, LONGER = "measured", "SSM", "LSTM", "LSTM, trained longer"
PAPERS_ROW = 2
"""Row of Table 2 whose network the paper selects."""
_REPETITION_OFFSET = 100
"""Offset of the repetition number, which separates the seeds from those of other parts."""
_TABLE_2, _TABLE_3, _TABLE_4 = "P1, Table 2", "P1, Table 3", "P1, Table 4"


@dataclass(frozen=True)
class NetworkRow:
    """Trained network of one row of Table 2.

    `validation` and `test` are the errors on these parts of the drive. `losses` (validations,) are half the squared
    errors on the validation part, summed over v and omega.
    """

    row: int
    parameters: int
    steps: int
    validation: VelocityFit
    test: VelocityFit
    losses: FloatArray


@dataclass(frozen=True)
class NetworkRows:
    """Networks of Table 2, trained on one drive."""

    rows: tuple[NetworkRow, ...]


@dataclass(frozen=True)
class NetworkResult:
    """Errors on free drives by model for one repetition; all models are identified from one drive.

    `motions` contains poses [m, m, rad] and twists [m/s, rad/s] (K, 5) of each drive, measured and by model.
    """

    repetition: int
    free_drives: Mapping[str, tuple[FreeDrive, ...]]
    motions: Sequence[Mapping[str, FloatArray]]


def compare_with_ssm(study: NetworkStudy, repetition: int) -> NetworkResult:
    """Identify an SSM and two networks from one drive, and predict other drives."""
    logs = RobotLogs(_REPETITION_OFFSET + repetition)
    drive = logs.free(1, study.train_duration, study.paper_range)
    drives = logs.free(study.free_drives, study.free_duration, study.paper_range)
    ssm = identify_ssm(drive, PAPERS_ORDER, limits=False)
    predictions = {SSM: tuple(free_drive(ssm.system, drive) for drive in drives)}
    motions = [
        {
            MEASURED: np.column_stack(
                [np.asarray(drive.pose), np.asarray(drive.twist)[:, 0], np.asarray(drive.yaw_rate)]
            ),
            SSM: _motion(drive, discretise(ssm.system, drive.dt).simulate(drive.command)),
        }
        for drive in drives
    ]
    architecture, default = Architecture(), training_settings()
    for name, settings in ((LSTM, default), (LONGER, default.model_copy(update=study.longer.model_dump()))):
        training, validation, _ = split_windows(
            windows_of(twist_experiments(drive), architecture.window), settings.shares
        )
        network = train(architecture, training, validation, settings).network
        twists = simulate_records(network, drives, "gyro")
        for record, motion, twist in zip(drives, motions, twists, strict=True):
            motion[name] = _motion(record, twist - network.rest_output)
        predictions[name] = tuple(
            FreeDrive(
                _velocity_fit(scores.fit_percent, scores.rmse), pose_error(motion[name][:, :3], motion[MEASURED][:, :3])
            )
            for drive, motion, twist in zip(drives, motions, twists, strict=True)
            for scores in [score([twist], twist_experiments([drive]))]
        )
    return NetworkResult(repetition, predictions, motions)


def _motion(drive: Record, twist: FloatArray) -> FloatArray:
    return np.hstack([dead_reckon(twist, np.asarray(drive.pose)[0], drive.dt), twist])


def train_rows(study: NetworkStudy, published: Mapping[int, PublishedNetwork], repetition: int) -> NetworkRows:
    """Train the networks in `published`, by row of Table 2, on the training drive of `compare_with_ssm`."""
    drive = RobotLogs(_REPETITION_OFFSET + repetition).free(1, study.train_duration, study.paper_range)
    experiments, rows = twist_experiments(drive), []
    for row, paper_row in published.items():
        architecture = Architecture(
            window=paper_row.window, units=paper_row.units, layers=paper_row.layers, activation=paper_row.activation
        )
        settings = training_settings().model_copy(
            update={
                "optimiser": paper_row.optimiser,
                "batch": paper_row.batch,
                "validation_every": paper_row.validation_every,
                "patience": paper_row.patience,
            }
        )
        training, validation, test = split_windows(windows_of(experiments, architecture.window), settings.shares)
        result = train(architecture, training, validation, settings)
        validation_fit, test_fit = (
            _velocity_fit(fit_percent(result.network, part), rmse(result.network, part)) for part in (validation, test)
        )
        rows.append(NetworkRow(row, architecture.parameters, result.steps, validation_fit, test_fit, result.losses))
    return NetworkRows(tuple(rows))


def _velocity_fit(fit: FloatArray, error: FloatArray) -> VelocityFit:
    return VelocityFit((float(fit[0]), float(fit[1])), (float(error[0]), float(error[1])))


def network_findings(
    results: Sequence[NetworkResult], rows: Sequence[NetworkRow], published: Published
) -> list[PaperFinding]:
    """Evaluate P1's findings on LSTM and SSM, and on the nine networks if all were trained."""
    findings = [_better_fit(results, published), _better_odometry(results, published)] if results else []
    if len(rows) == len(published.networks):
        findings.append(_best_row(rows, published))
    return findings


def _better_fit(results: Sequence[NetworkResult], published: Published) -> PaperFinding:
    ssm, lstm = (
        np.array(
            [np.mean([drive.velocity.fit_percent for drive in result.free_drives[name]], axis=0) for result in results]
        )
        for name in (SSM, LSTM)
    )
    template = "SSM {:.2f} and {:.2f}, LSTM {:.2f} and {:.2f} %"
    paper = [*published.free_drives_average.values[:2], *published.lstm_drives_average.values[:2]]
    return PaperFinding(
        "on free drives SSM explains v and omega better than LSTM (FIT)",
        _TABLE_3,
        template.format(*paper),
        template.format(*ssm.mean(axis=0), *lstm.mean(axis=0)),
        as_flags((ssm > lstm).all(axis=1)),
    )


def _better_odometry(results: Sequence[NetworkResult], published: Published) -> PaperFinding:
    def errors(name: str) -> FloatArray:
        return np.array(
            [
                np.mean(
                    [(drive.odometry.position.rmse, drive.odometry.heading.rmse) for drive in result.free_drives[name]],
                    axis=0,
                )
                for result in results
            ]
        )

    ssm, lstm = errors(SSM), errors(LSTM)
    template = "SSM {:.2f} m and {:.2f} rad, LSTM {:.2f} m and {:.2f} rad"
    paper = [
        value
        for drive in (published.free_drives_average, published.lstm_drives_average)
        for value in (drive.odometry.position[0], drive.odometry.heading[0])
    ]
    return PaperFinding(
        "open-loop odometry of SSM has smaller errors than that of LSTM, in position and in heading (RMSE)",
        _TABLE_4,
        template.format(*paper),
        template.format(*ssm.mean(axis=0), *lstm.mean(axis=0)),
        as_flags((ssm < lstm).all(axis=1)),
    )


def _best_row(rows: Sequence[NetworkRow], published: Published) -> PaperFinding:
    ours = {row.row: float(np.mean(row.test.fit_percent)) for row in rows}
    printed = {row: float(np.mean(scores.test.values[:2])) for row, scores in published.networks.items()}
    descriptions = []
    for means in (printed, ours):
        best = max(means, key=means.__getitem__)
        descriptions.append(f"row {best} with {means[best]:.2f} %, row {PAPERS_ROW} with {means[PAPERS_ROW]:.2f} %")
    return PaperFinding(
        f"the network of row {PAPERS_ROW} has the best test FIT of the nine (mean of v and omega)",
        f"text on {_TABLE_2}, which contradicts the table",
        descriptions[0],
        descriptions[1],
        (max(ours, key=ours.__getitem__) == PAPERS_ROW,),
    )


def row_table(rows: Sequence[NetworkRow], published: Published) -> Table:
    """Tabulate the published and the measured errors of the nine networks."""
    table_rows = []
    for row in sorted(rows, key=lambda row: row.row):
        scores = published.networks[row.row]
        architecture = f"{scores.layers} x {scores.units}, {scores.activation}, {scores.optimiser}"
        training = f"{scores.window}, {scores.batch}, {scores.validation_every}, {scores.patience}"
        paper = [number(value, 2) for value in scores.test.values]
        ours = [number(value, 2 if k < 2 else 4) for k, value in enumerate(row.test.values)]
        validation = [number(value, 2) for value in row.validation.fit_percent]
        table_rows.append(
            (str(row.row), architecture, training, *paper, *ours, *validation, str(row.parameters), str(row.steps))
        )
    columns = (
        "row",
        "layers x units, dense layer, optimiser",
        "window, batch, validation every, patience",
        *(f"published {name}" for name in FIT_COLUMNS),
        *FIT_COLUMNS,
        "FIT v, validation [%]",
        "FIT omega, validation [%]",
        "parameters",
        "steps",
    )
    note = (
        "Published: P1, Table 2, test. Ours: the last 10 % of one drive; one training with one seed for each network. "
        "The paper does not state the learning rate (here 0.001) or which weights are used (here those of the best "
        "validation)."
    )
    return Table("The nine networks", columns, tuple(table_rows), 3, note)


def free_drive_tables(results: Sequence[NetworkResult], published: Published) -> list[Table]:
    """Tabulate the published and the measured velocity and odometry errors of SSM and LSTM on free drives."""
    table_rows: list[tuple[str, str, FloatArray, bool]] = []  # the flag is True for published values
    paper = {SSM: (published.free_drives, published.free_drives_average)}
    paper[LSTM] = (published.lstm_drives, published.lstm_drives_average)
    for name, (drives, average) in paper.items():
        experiments = [(f"experiment {k}", experiment) for k, experiment in enumerate(drives, start=1)]
        for label, drive in [*experiments, ("average", average)]:
            values = np.array([*drive.values, *drive.odometry.position, *drive.odometry.heading])
            table_rows.append((f"published {name}", label, values, True))
    for name in results[0].free_drives:
        ours = np.array([drive.values for result in results for drive in result.free_drives[name]])
        table_rows.append((name, f"average of {len(ours)}", ours.mean(axis=0), False))
    errors = [f"{name} [{unit}], {statistic}" for name, unit in QUANTITIES.items() for statistic in STATISTICS]
    fits = [
        (name, label, *(number(float(v), 2 if k < 2 or is_published else 4) for k, v in enumerate(values[:4])))
        for name, label, values, is_published in table_rows
    ]
    paths = [(name, label, *(number(float(v), 2) for v in values[4:])) for name, label, values, _ in table_rows]
    note = (
        "Ours: identified from one drive of five minutes, validated on drives of 30 s, all with set-points up to "
        f"1.5 m/s and 2.0 rad/s; mean over repetitions. '{LONGER}': no dropout, less decay, more patience."
    )
    return [
        Table("SSM and LSTM velocity", ("model", "drive", *FIT_COLUMNS), tuple(fits), 2, f"P1, Table 3. {note}"),
        Table("SSM and LSTM odometry", ("model", "drive", *errors), tuple(paths), 2, f"P1, Table 4. {note}"),
    ]
