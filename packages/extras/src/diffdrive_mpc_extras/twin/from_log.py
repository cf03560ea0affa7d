"""Fit of a twin to logs of a robot, and its scores on held-out rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.identification.effects.free_run import sensor_experiments
from diffdrive_mpc.models.identification.effects.pose_sensor import pose_sensor
from diffdrive_mpc.models.identification.from_logs import identify_data
from diffdrive_mpc.models.identification.log_data import LogData, read_data
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.load import load_linear_model, model_path, read_model_file
from diffdrive_mpc.models.logs import Finding, Record
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, join_experiments
from diffdrive_mpc.models.structures.model_file import ModelFile
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.sim.plants.plant import RobotLostError
from diffdrive_mpc_extras.twin.fitting import TwinFit, fit_twin
from diffdrive_mpc_extras.twin.free_run import most_active_windows
from diffdrive_mpc_extras.twin.held_out import (
    HeldOutPrediction,
    HeldOutScore,
    ModelWithSensors,
    fit_percent,
    model_with_sensors,
    pose_drifts,
    predict_with_model,
    predict_with_twin,
)
from diffdrive_mpc_extras.twin.nominal import nominal_robot
from diffdrive_mpc_extras.twin.problem import TaskRunner, TwinProblem, run_sequentially
from diffdrive_mpc_extras.twin.settings import twin_settings
from diffdrive_mpc_extras.twin.space import space_of

MIN_SECONDS = 5.0
"""Minimum duration of a log for the fit [s]."""


@dataclass(frozen=True, eq=False)
class FittedTwin:
    """Result of the fit to a log.

    Attributes
    ----------
    name
        Name of the robot.
    data
        Training and held-out rows of the logs.
    fit
        Fitted plant.
    model
        Identified velocity model that the twin is compared with.
    model_name
        Name of the model.
    twin_score, model_score
        Scores of twin and model on the held-out rows.
    experiments
        Held-out rows.
    notes
        Notes about missing results and limitations.
    """

    name: str
    data: LogData
    fit: TwinFit
    model: ModelWithSensors
    model_name: str
    twin_score: HeldOutScore
    model_score: HeldOutScore
    experiments: tuple[SampledExperiment, ...]
    notes: tuple[str, ...]


def fit_twin_to_logs(
    logs: Sequence[Path],
    *,
    mapping: str | Path | None = None,
    robot: str | Path | None = None,
    model: str | Path | None = None,
    effects: bool = False,
    seconds: float | None = None,
    name: str | None = None,
    force: bool = False,
    run_tasks: TaskRunner = run_sequentially,
    on_findings: Callable[[Sequence[Finding]], None] | None = None,
    on_stage: Callable[[str, int], None] | None = None,
    on_drive: Callable[[], None] | None = None,
) -> FittedTwin:
    """Fit the MuJoCo plant to logs of one robot: the first 60 % of each log for the fit, the rest for the scores.

    Parameters
    ----------
    logs, mapping, force, on_findings
        As in `models.identification.identify`.
    robot
        Robot file with known values of the robot: mass, wheel base, motors; shipped name or path.
    model
        Identified model for the initial values and the comparison; by default an SM identified from the same rows.
    effects
        True to identify the effects of the base for that SM.
    seconds
        Duration of the fitted windows [s]; by default the value of the settings.
    name
        Name of the robot; by default from the logs.
    run_tasks
        Function that runs several simulations of the plant.
    on_stage
        Called with the name of the next stage, and the approximate number of its drives.
    on_drive
        Called after each simulation of the fitted windows.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If an argument or a log cannot be used; the message is one line.
    """
    settings = twin_settings()
    announce = on_stage or (lambda _text, _count: None)
    if seconds is not None and not (np.isfinite(seconds) and seconds >= MIN_SECONDS):
        raise ConfigError(f"--seconds {seconds:g}: use {MIN_SECONDS:g} or more")
    if model is not None and effects:
        raise ConfigError("--effects: the file of --model already states the effects; use one of these options")
    content = None if model is None else _model_content(model)
    announce("reading", 1)
    data = read_data(
        logs,
        [],
        mapping=mapping,
        fit_share=identification_settings().fit_share,
        wheels=False,
        on_findings=on_findings or (lambda _: None),
        force=force,
        max_rows=identification_settings().max_rows["effects"],
    )
    title = name or f"twin from {Path(logs[0]).stem}"
    nominal = nominal_robot(title, data.train, robot)
    if content is None:
        announce("identifying the velocity model", 1)
        report = identify_data(data, STRUCTURES["sm"], f"SM of {title}", effects=effects).content
        assert isinstance(report, ModelFile)
        content = report
    experiments = sensor_experiments(data.train, data.yaw)
    velocity_model = model_with_sensors(content, join_experiments(experiments))
    has_gyro = data.yaw == "gyro"
    sensors = {"gyro.offset": 0.0, "encoders.delay": 0.0} | dict(velocity_model.sensors)
    poses = pose_sensor(data.train, sensors) if has_gyro else None
    mount = dict(zip(poses.names, map(float, poses.values), strict=True)) if poses else None
    travel = mount["pose.travel"] if mount else 1.0
    nominal = nominal.with_limits(velocity_model.limits)
    has_lag = "encoders.lag" in velocity_model.sensors
    space = space_of(nominal, velocity_model.effects, has_gyro=has_gyro, has_encoder_lag=has_lag, travel=travel)
    dc_gain = velocity_model.model.dc_gain
    windows = most_active_windows(join_experiments(experiments), dc_gain, seconds or settings.seconds)
    problem = TwinProblem(space, windows, run_tasks, on_drive or (lambda: None))
    fit = fit_twin(problem, velocity_model.start(nominal), on_stage)
    announce("predicting the held-out rows", 1)
    held_out = sensor_experiments(data.validation, data.yaw)
    notes = [*_notes(velocity_model), energy_note([*data.train, *data.validation])]

    def score(predictions: Sequence[HeldOutPrediction], metres: float) -> HeldOutScore:
        drift = pose_drifts(data.validation, predictions, mount, travel=metres, on_missing=notes.append)
        return HeldOutScore(fit_percent(predictions, held_out), drift, tuple(predictions))

    try:
        twin_score = score(predict_with_twin(fit, velocity_model, held_out), 1.0)
    except RobotLostError as error:
        raise ConfigError(f"the fitted plant fails on the held-out rows: {error}") from error
    model_score = score(predict_with_model(velocity_model, held_out), travel)
    return FittedTwin(
        title,
        data,
        fit,
        velocity_model,
        content.name,
        twin_score,
        model_score,
        tuple(held_out),
        tuple(dict.fromkeys(notes)),
    )


def energy_note(records: Sequence[Record]) -> str:
    """Format the note that energies of drives with the plant are inaccurate, because motor losses are not fitted."""
    has_no_currents = all(record.motor_current is None and record.battery is None for record in records)
    reason = "the log contains no currents" if has_no_currents else "the currents of the log are not fitted"
    return (
        f"energy and power of a drive with this plant use prior motor losses and may be several times too high or too "
        f"low: {reason}; use them to compare drives, not to size a battery"
    )


def _model_content(model: str | Path) -> ModelFile:
    """Load the file of a linear model; raise ConfigError, or ModelError for a nonlinear model."""
    load_linear_model(model)
    path = model_path(model)
    read_yaml(path)
    return read_model_file(path)


def _notes(model: ModelWithSensors) -> Sequence[str]:
    """List the parts of the identified model that the plant lacks or takes over."""
    notes = []
    if model.effects.yaw_relaxation is not None:
        notes.append(
            "the plant does not model tyre twist (yaw_relaxation): its contacts relax with time, not with the angle"
        )
    if model.effects.wheel_command is not None:
        notes.append("steps, coasting and top speed of the wheels come from the model; they are not fitted again")
    if np.isfinite(model.limits).any():
        notes.append("the plant clips commands at the limits of the identified model")
    delayed = [name for name in ("encoders.delay", "encoders.lag") if abs(model.sensors.get(name, 0.0)) > 0.0]
    if delayed:
        notes.append("delay and lag of the log's encoders are fitted; the encoders of the plant have no delay")
    return notes
