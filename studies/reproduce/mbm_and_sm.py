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
    pose_error,
    predict_path,
    sampled,
)
from studies.reproduce.published import MbmSmStudy, PaperFinding, Published, as_flags

MBM, MBM_TRACKS, SM = "MBM", "MBM, own tracks", "SM"
COMPARED = (MBM, MBM_TRACKS, SM)
"""MBM as in the paper, MBM with identified tracks, and SM."""
DATA = ("steps used", "steps held out", "free drives")
_HELD_OUT = DATA[1]
_CIRCLE = "circle"
_MOTORS = ("front left", "front right", "rear left", "rear right")


@dataclass(frozen=True)
class MbmSmResult:
    """Result of one repetition.

    Attributes
    ----------
    repetition
        Number of the repetition.
    motor_fit
        FIT of the motors front left, front right, rear left, rear right [%], by data set.
    sm_fit
        FIT of v and omega [%], by data set.
    errors
        Errors by model and trajectory.
    paths
        Poses (K, 3) by trajectory and by model; the driven poses have the name "driven".
    responses
        Measured and simulated speeds (K, 2) [rad/s, m/s] of the held-out steps, by motor and by channel of SM.
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

    In the paper, MBM converts commands to wheel speeds, and these to twists, with the robot's geometric track. In "MBM,
    own tracks", the firmware's track and the effective track of the gyro are identified.
    """
    logs, robot = RobotLogs(repetition), load_robot()
    used, held_out = ({kind: logs.steps(kind) for kind in STEP_KINDS} for _ in range(2))
    free = logs.free(study.free_drives, study.free_duration)
    own_tracks = identify_mbm([*used["wheels"], *used["omega"]], robot.wheel_radius)
    sm = identify_sm([*used["v"], *used["omega"]], limits=False)
    geometric = {"firmware_track": robot.track, "effective_track": robot.track}
    mbm = replace(own_tracks, content={**own_tracks.content, **geometric})
    models = {MBM: mbm, MBM_TRACKS: own_tracks, SM: sm}
    paths = {name: _paths(models, logs.trajectory(name)) for name in study.trajectories}
    of_motors = dict(zip(DATA, (used["wheels"], held_out["wheels"], free), strict=True))
    # Each channel has separate steps, as in the paper.
    of_v = dict(zip(DATA, (used["v"], held_out["v"], free), strict=True))
    of_omega = dict(zip(DATA, (used["omega"], held_out["omega"], free), strict=True))
    return MbmSmResult(
        repetition,
        motor_fit={name: motor_fit(own_tracks, records) for name, records in of_motors.items()},
        sm_fit={name: (_fit(sm, of_v[name], 0), _fit(sm, of_omega[name], 1)) for name in DATA},
        errors={
            model: {name: pose_error(by_model[model], by_model["driven"]) for name, by_model in paths.items()}
            for model in models
        },
        paths=paths,
        responses=_responses(own_tracks, sm, held_out),
        parameters={MBM: own_tracks.content, SM: sm.content},
        warnings={MBM: lines(own_tracks.warnings), SM: lines(sm.warnings)},
    )


def motor_fit(mbm: IdentifiedModel, records: Sequence[Record]) -> tuple[float, ...]:
    """Compute the FIT of each motor's simulated speed [%], pooled over records."""
    stretches = wheel_experiments(records)
    simulated = [simulate_experiment(mbm.fits[0].system, stretch) for stretch in stretches]
    return tuple(
        pooled_fit_percent([stretch.outputs[:, motor] for stretch in stretches], [y[:, motor] for y in simulated])
        for motor in range(stretches[0].outputs.shape[1])
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


def _paths(models: Mapping[str, IdentifiedModel], driven: Record) -> dict[str, FloatArray]:
    pose = np.asarray(driven.pose)
    predicted = {
        name: predict_path(sampled(identified.system, driven.dt), driven.command, pose[0])
        for name, identified in models.items()
    }
    return {"driven": pose, **predicted}


def mbm_sm_findings(results: Sequence[MbmSmResult], published: Published) -> list[PaperFinding]:
    """Compare FIT of motors and channels, and the prediction of paths."""
    minimum, fit = published.motor_fit_percent, published.sm_fit_percent
    motors = np.array([result.motor_fit[_HELD_OUT] for result in results])
    channels = np.array([result.sm_fit[_HELD_OUT] for result in results])
    v, omega = channels.mean(axis=0)
    return [
        PaperFinding(
            f"two poles without zeros explain every motor with a FIT above {minimum:g} % (steps held out)",
            "P0, section on MBM",
            f"all four > {minimum:g} %",
            f"{motors.mean(axis=0).min():.1f} to {motors.mean(axis=0).max():.1f} %",
            as_flags((motors > minimum).all(axis=1)),
        ),
        PaperFinding(
            "SM explains v better than omega (steps held out)",
            "P0, section on SM",
            f"{fit.v:.2f} against {fit.omega:.2f} %",
            f"{v:.2f} against {omega:.2f} %",
            as_flags(channels[:, 0] > channels[:, 1]),
        ),
        *(_beats_sm(results, published, MBM, "MBM", quantity) for quantity in QUANTITIES),
        *(_beats_sm(results, published, MBM_TRACKS, "MBM with identified tracks", quantity) for quantity in QUANTITIES),
        *([_circle_is_worst(results, published)] if _CIRCLE in results[0].errors[SM] else []),
    ]


def _beats_sm(
    results: Sequence[MbmSmResult], published: Published, model: str, words: str, quantity: str
) -> PaperFinding:
    ours, theirs = _rmse(results, model, quantity), _rmse(results, SM, quantity)
    printed = [_printed(published, model_name, list(results[0].errors[SM]), quantity) for model_name in ("mbm", "sm")]
    return PaperFinding(
        f"{words} predicts the {quantity} better than SM on every trajectory (RMSE)",
        "P0, Table 2" if model == MBM else "P0, Table 2; the tracks are ours",
        _comparison(printed[0], printed[1], QUANTITIES[quantity]),
        _comparison(ours.mean(axis=0), theirs.mean(axis=0), QUANTITIES[quantity]),
        as_flags((ours < theirs).all(axis=1)),
    )


def _circle_is_worst(results: Sequence[MbmSmResult], published: Published) -> PaperFinding:
    names = list(results[0].errors[SM])
    circle = names.index(_CIRCLE)
    printed = {model_name.upper(): _printed(published, model_name, names, "position") for model_name in ("mbm", "sm")}
    ours = {model_name: _rmse(results, model_name, "position") for model_name in (MBM, SM)}
    worst = np.array([table.argmax(axis=1) for table in ours.values()])
    return PaperFinding(
        "the circle has the largest position RMSE, for MBM and for SM",
        "P0, Table 2",
        ", ".join(f"{model_name}: {names[int(values.argmax())]}" for model_name, values in printed.items()),
        ", ".join(f"{model_name}: {names[int(table.mean(axis=0).argmax())]}" for model_name, table in ours.items()),
        as_flags((worst == circle).all(axis=0)),
    )


def _rmse(results: Sequence[MbmSmResult], model: str, quantity: str) -> FloatArray:
    """Return RMSE (repetitions, trajectories)."""
    return np.array([[getattr(error, quantity).rmse for error in result.errors[model].values()] for result in results])


def _printed(published: Published, model: str, names: Sequence[str], quantity: str) -> FloatArray:
    """Return the printed RMSE (trajectories,), the first of the printed statistics."""
    return np.array([getattr(published.odometry[model][name], quantity)[0] for name in names])


def _comparison(ours: FloatArray, theirs: FloatArray, unit: str) -> str:
    a, b = float(ours.mean()), float(theirs.mean())
    return f"{np.sum(ours < theirs)} of {len(ours)}; mean {a:.3f} against {b:.3f} {unit} ({100 * (a / b - 1):+.0f} %)"


def mbm_sm_tables(results: Sequence[MbmSmResult], published: Published) -> list[Table]:
    """Tabulate FIT, and position and heading errors by trajectory and statistic."""
    return [_fit_table(results, published), *(_odometry(results, published, quantity) for quantity in QUANTITIES)]


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
        "FIT [%] of a free simulation from commands, mean over repetitions. The paper does not state the data of its "
        "figures. Separate steps: wheels for the motors, v and omega for SM."
    )
    columns = ("model", "output", "published", *DATA)
    return Table("FIT of motors and of SM", columns, tuple(rows), text_columns=2, note=note)


def _odometry(results: Sequence[MbmSmResult], published: Published, quantity: str) -> Table:
    names = list(results[0].errors[SM])
    ours = {model: _errors(results, model, quantity) for model in COMPARED}
    printed = {
        model: np.array([getattr(published.odometry[model][name], quantity) for name in names])
        for model in ("mbm", "sm")
    }
    rows = []
    for i, statistic in enumerate(STATISTICS):
        for k, name in enumerate((*names, "average")):
            of_paper = [_cell(printed[model], k, i) for model in printed]
            of_plant = [_cell(ours[model], k, i) for model in COMPARED]
            rows.append((statistic, name, *of_paper, *of_plant))
    columns = (f"error [{QUANTITIES[quantity]}]", "trajectory", "published MBM", "published SM", *COMPARED)
    note = (
        "Predicted from commands alone, against the true pose; mean over repetitions. Published: P0, Table 2, "
        "averages from its rows. The paper does not state twists and durations, so the paths have the same shape, but "
        "another size."
    )
    title = f"{quantity.capitalize()} errors of open-loop odometry"
    return Table(title, columns, tuple(rows), text_columns=2, note=note)


def _errors(results: Sequence[MbmSmResult], model: str, quantity: str) -> FloatArray:
    """Compute mean error statistics over repetitions (trajectories, statistics)."""
    every = [[getattr(error, quantity).statistics for error in result.errors[model].values()] for result in results]
    return np.asarray(np.mean(every, axis=0))


def _cell(table: FloatArray, row: int, column: int) -> str:
    values = table[:, column]
    return number(float(values[row] if row < len(values) else values.mean()), 3)
