"""MBM and SM identified from steps, compared on trajectories (Guffanti et al., Sensors 2025, 25(11), 3553)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.doubt import lines
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import twist_experiments, wheel_experiments
from diffdrive_mpc.models.output_error.validation import pooled_fit_percent, simulate_experiment, validate
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.mbm import identify_mbm
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.models.velocity_model import CHANNELS
from studies.reproduce.drives import (
    QUANTITIES,
    STATISTICS,
    STEP_KINDS,
    PathError,
    RobotLogs,
    discretise,
    pose_error,
    predict_path,
)
from studies.reproduce.published import MbmSmStudy, PaperFinding, Published, as_flags

MBM, MBM_TRACKS, SM = "MBM", "MBM, identified tracks", "SM"
COMPARED = (MBM, MBM_TRACKS, SM)
"""Names of the compared models: MBM as in the paper, MBM with identified tracks, and SM."""
DATA = ("training steps", "validation steps", "free drives")
"""Names of the data sets, in the order of the table."""
_VALIDATION = DATA[1]
_CIRCLE = "circle"
_MOTORS = ("front left", "front right", "rear left", "rear right")


@dataclass(frozen=True)
class MbmSmResult:
    """FIT and path errors of MBM and SM for one repetition.

    Attributes
    ----------
    repetition
        Number of the repetition.
    motor_fit
        FIT of the motors [%] by data set: front left, front right, rear left, rear right.
    sm_fit
        FIT of v and omega [%] by data set.
    errors
        Errors by model and trajectory.
    paths
        Poses (K, 3) by trajectory and model; "driven" is the name of the true poses.
    responses
        Measured and simulated speeds (K, 2) of the validation steps by motor [rad/s] and by channel [m/s, rad/s].
    parameters
        Identified parameters by model.
    warnings
        Warnings of the identification by model.
    """

    repetition: int
    motor_fit: Mapping[str, tuple[float, ...]]
    sm_fit: Mapping[str, tuple[float, float]]
    errors: Mapping[str, Mapping[str, PathError]]
    paths: Mapping[str, Mapping[str, FloatArray]]
    responses: Mapping[str, FloatArray]
    parameters: Mapping[str, Mapping[str, Any]]
    warnings: Mapping[str, tuple[str, ...]]


def compare_mbm_and_sm(study: MbmSmStudy, repetition: int) -> MbmSmResult:
    """Identify MBM and SM from the paper's steps and predict the paper's trajectories.

    In the paper, MBM uses the geometric track of the robot to convert commands to wheel speeds, and wheel speeds to
    twists. The variant "MBM, identified tracks" uses the identified track of the firmware and the effective track.
    """
    logs, robot = RobotLogs(repetition), load_robot()
    training, held_out = ({kind: logs.steps(kind) for kind in STEP_KINDS} for _ in range(2))
    free = logs.free(study.free_drives, study.free_duration)
    identified_mbm = identify_mbm([*training["wheels"], *training["omega"]], robot.wheel_radius)
    sm = identify_sm([*training["v"], *training["omega"]], limits=False)
    geometric = {"firmware_track": robot.track, "effective_track": robot.track}
    mbm = replace(identified_mbm, content={**identified_mbm.content, **geometric})
    models = {MBM: mbm, MBM_TRACKS: identified_mbm, SM: sm}
    paths = {name: _predict_paths(models, logs.trajectory(name)) for name in study.trajectories}
    motor_records = dict(zip(DATA, (training["wheels"], held_out["wheels"], free), strict=True))
    # Each channel is identified from separate steps, as in the paper.
    v_records = dict(zip(DATA, (training["v"], held_out["v"], free), strict=True))
    omega_records = dict(zip(DATA, (training["omega"], held_out["omega"], free), strict=True))
    return MbmSmResult(
        repetition,
        motor_fit={name: motor_fit(identified_mbm, records) for name, records in motor_records.items()},
        sm_fit={name: (_fit(sm, v_records[name], 0), _fit(sm, omega_records[name], 1)) for name in DATA},
        errors={
            model: {name: pose_error(model_paths[model], model_paths["driven"]) for name, model_paths in paths.items()}
            for model in models
        },
        paths=paths,
        responses=_responses(identified_mbm, sm, held_out),
        parameters={MBM: identified_mbm.content, SM: sm.content},
        warnings={MBM: lines(identified_mbm.warnings), SM: lines(sm.warnings)},
    )


def motor_fit(mbm: IdentifiedModel, records: Sequence[Record]) -> tuple[float, ...]:
    """Compute the FIT of each motor's simulated speed [%], pooled over records."""
    experiments = wheel_experiments(records)
    simulated = [simulate_experiment(mbm.fits[0].system, experiment) for experiment in experiments]
    return tuple(
        pooled_fit_percent([run.outputs[:, motor] for run in experiments], [y[:, motor] for y in simulated])
        for motor in range(experiments[0].outputs.shape[1])
    )


def _responses(mbm: IdentifiedModel, sm: IdentifiedModel, steps: Mapping[Any, list[Record]]) -> dict[str, FloatArray]:
    motors = [(motor, mbm.fits[0].system, wheel_experiments(steps["wheels"]), k) for k, motor in enumerate(_MOTORS)]
    channels = [(name, sm.system, twist_experiments(steps[name]), k) for k, name in enumerate(CHANNELS)]
    return {
        name: np.vstack([np.stack([run.outputs[:, k], simulate_experiment(system, run)[:, k]], 1) for run in runs])
        for name, system, runs, k in motors + channels
    }


def _fit(sm: IdentifiedModel, records: Sequence[Record], channel: int) -> float:
    return float(validate(sm.system, records).fit_percent[channel])


def _predict_paths(models: Mapping[str, IdentifiedModel], driven: Record) -> dict[str, FloatArray]:
    pose = np.asarray(driven.pose)
    predicted = {
        name: predict_path(discretise(identified.system, driven.dt), driven.command, pose[0])
        for name, identified in models.items()
    }
    return {"driven": pose, **predicted}


def mbm_sm_findings(results: Sequence[MbmSmResult], published: Published) -> list[PaperFinding]:
    """Evaluate P0's findings on the FIT of motors and channels and on predicted paths."""
    minimum, fit = published.motor_fit_percent, published.sm_fit_percent
    motors = np.array([result.motor_fit[_VALIDATION] for result in results])
    channels = np.array([result.sm_fit[_VALIDATION] for result in results])
    v, omega = channels.mean(axis=0)
    return [
        PaperFinding(
            f"two poles without zeros explain every motor with a FIT above {minimum:g} % (validation steps)",
            "P0, section on MBM",
            f"all four > {minimum:g} %",
            f"{motors.mean(axis=0).min():.1f} to {motors.mean(axis=0).max():.1f} %",
            as_flags((motors > minimum).all(axis=1)),
        ),
        PaperFinding(
            "SM explains v better than omega (validation steps)",
            "P0, section on SM",
            f"{fit.v:.2f} against {fit.omega:.2f} %",
            f"{v:.2f} against {omega:.2f} %",
            as_flags(channels[:, 0] > channels[:, 1]),
        ),
        *(_compare(results, published, MBM, "MBM", quantity) for quantity in QUANTITIES),
        *(_compare(results, published, MBM_TRACKS, "MBM with identified tracks", quantity) for quantity in QUANTITIES),
        *([_circle_is_worst(results, published)] if _CIRCLE in results[0].errors[SM] else []),
    ]


def _compare(
    results: Sequence[MbmSmResult], published: Published, model: str, description: str, quantity: str
) -> PaperFinding:
    ours, sm_errors = _rmse(results, model, quantity), _rmse(results, SM, quantity)
    names = list(results[0].errors[SM])
    printed = [_paper_rmse(published, paper_model, names, quantity) for paper_model in ("mbm", "sm")]
    return PaperFinding(
        f"{description} predicts the {quantity} better than SM on every trajectory (RMSE)",
        "P0, Table 2" if model == MBM else "P0, Table 2; tracks identified by this project",
        _comparison(printed[0], printed[1], QUANTITIES[quantity]),
        _comparison(ours.mean(axis=0), sm_errors.mean(axis=0), QUANTITIES[quantity]),
        as_flags((ours < sm_errors).all(axis=1)),
    )


def _circle_is_worst(results: Sequence[MbmSmResult], published: Published) -> PaperFinding:
    names = list(results[0].errors[SM])
    circle = names.index(_CIRCLE)
    printed = {name.upper(): _paper_rmse(published, name, names, "position") for name in ("mbm", "sm")}
    ours = {model_name: _rmse(results, model_name, "position") for model_name in (MBM, SM)}
    worst_trajectories = np.array([table.argmax(axis=1) for table in ours.values()])
    return PaperFinding(
        "the circle has the maximum position RMSE, for MBM and for SM",
        "P0, Table 2",
        ", ".join(f"{model_name}: {names[int(values.argmax())]}" for model_name, values in printed.items()),
        ", ".join(f"{model_name}: {names[int(table.mean(axis=0).argmax())]}" for model_name, table in ours.items()),
        as_flags((worst_trajectories == circle).all(axis=0)),
    )


def _rmse(results: Sequence[MbmSmResult], model: str, quantity: str) -> FloatArray:
    """Return the RMSE (repetitions, trajectories) of a model."""
    return np.array([[getattr(error, quantity).rmse for error in result.errors[model].values()] for result in results])


def _paper_rmse(published: Published, model: str, names: Sequence[str], quantity: str) -> FloatArray:
    """Return the published RMSE (trajectories,), the first statistic in the paper's table."""
    return np.array([getattr(published.odometry[model][name], quantity)[0] for name in names])


def _comparison(mbm: FloatArray, sm: FloatArray, unit: str) -> str:
    """Format the number of trajectories on which MBM is better than SM, and the mean errors of both models."""
    mean, sm_mean = float(mbm.mean()), float(sm.mean())
    means = f"mean {mean:.3f} against {sm_mean:.3f} {unit}"
    return f"{np.sum(mbm < sm)} of {len(mbm)}; {means} ({100 * (mean / sm_mean - 1):+.0f} %)"


def mbm_sm_tables(results: Sequence[MbmSmResult], published: Published) -> list[Table]:
    """Tabulate FIT, and the statistics of position and heading errors by trajectory."""
    return [_fit_table(results, published), *(_odometry_table(results, published, quantity) for quantity in QUANTITIES)]


def _fit_table(results: Sequence[MbmSmResult], published: Published) -> Table:
    """Tabulate FIT of the four motors and of both channels of SM."""
    motors = {name: np.mean([result.motor_fit[name] for result in results], axis=0) for name in DATA}
    channels = {name: np.mean([result.sm_fit[name] for result in results], axis=0) for name in DATA}
    printed = published.sm_fit_percent.model_dump()
    rows = [
        ("MBM", motor, f"> {published.motor_fit_percent:g}", *(number(float(motors[name][i]), 2) for name in DATA))
        for i, motor in enumerate(_MOTORS)
    ]
    rows += [
        ("SM", channel, number(printed[channel], 2), *(number(float(channels[name][i]), 2) for name in DATA))
        for i, channel in enumerate(CHANNELS)
    ]
    note = (
        "FIT [%] of a free simulation from commands, mean over repetitions. The paper does not state which data its "
        "values are from. The motors, v and omega have separate steps."
    )
    columns = ("model", "output", "published", *DATA)
    return Table("FIT of motors and of SM", columns, tuple(rows), text_columns=2, note=note)


def _odometry_table(results: Sequence[MbmSmResult], published: Published, quantity: str) -> Table:
    names = list(results[0].errors[SM])
    ours = {model: _errors(results, model, quantity) for model in COMPARED}
    printed = {
        model: np.array([getattr(published.odometry[model][name], quantity) for name in names])
        for model in ("mbm", "sm")
    }
    rows = []
    for i, statistic in enumerate(STATISTICS):
        for k, name in enumerate((*names, "average")):
            published_cells = [_cell(printed[model], k, i) for model in printed]
            measured_cells = [_cell(ours[model], k, i) for model in COMPARED]
            rows.append((statistic, name, *published_cells, *measured_cells))
    columns = (f"error [{QUANTITIES[quantity]}]", "trajectory", "published MBM", "published SM", *COMPARED)
    note = (
        "Prediction from commands alone, relative to the true pose; mean over repetitions. Published: P0, Table 2, and "
        "averages of its rows. The paper does not state twists and durations, so the paths have the same shape but a "
        "different size."
    )
    title = f"{quantity.capitalize()} errors of open-loop odometry"
    return Table(title, columns, tuple(rows), text_columns=2, note=note)


def _errors(results: Sequence[MbmSmResult], model: str, quantity: str) -> FloatArray:
    """Compute the error statistics (trajectories, statistics), averaged over repetitions."""
    rows = [[getattr(error, quantity).statistics for error in result.errors[model].values()] for result in results]
    return np.asarray(np.mean(rows, axis=0))


def _cell(table: FloatArray, row: int, column: int) -> str:
    values = table[:, column]
    return number(float(values[row] if row < len(values) else values.mean()), 3)
