"""From a log of a robot to its twin, and how far to trust it."""

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
from diffdrive_mpc_extras.twin.free_run import most_telling
from diffdrive_mpc_extras.twin.held_out import (
    HeldOutPrediction,
    HeldOutScore,
    Identified,
    drift_of,
    fit_percent,
    hold_model,
    hold_twin,
    identified,
)
from diffdrive_mpc_extras.twin.nominal import nominal_robot
from diffdrive_mpc_extras.twin.problem import Together, TwinProblem, one_by_one
from diffdrive_mpc_extras.twin.settings import twin_settings
from diffdrive_mpc_extras.twin.space import space_of

LEAST_SECONDS = 5.0
"""Minimum duration of a log for the fit [s]."""


@dataclass(frozen=True, eq=False)
class FittedTwin:
    """Result of the fit to a log.

    Attributes
    ----------
    name
        Name of the robot.
    data
        The log, divided.
    fit
        The plant.
    model
        The identified velocity model beside it, and its name.
    model_name
        Name of the model.
    twin_held, model_held
        Both on the rows held out.
    experiments
        Those rows.
    notes
        Notes about missing results and other peculiarities.
    """

    name: str
    data: LogData
    fit: TwinFit
    model: Identified
    model_name: str
    twin_held: HeldOutScore
    model_held: HeldOutScore
    experiments: tuple[SampledExperiment, ...]
    notes: tuple[str, ...]


def twin_of(
    logs: Sequence[Path],
    *,
    mapping: str | Path | None = None,
    robot: str | Path | None = None,
    model: str | Path | None = None,
    effects: bool = False,
    seconds: float | None = None,
    name: str | None = None,
    force: bool = False,
    together: Together = one_by_one,
    on_findings: Callable[[Sequence[Finding]], None] | None = None,
    on_stage: Callable[[str, int], None] | None = None,
    on_drive: Callable[[], None] | None = None,
) -> FittedTwin:
    """Fit the physics to logs of one robot; the first 60 % of each are fitted, the others are for the scores.

    Parameters
    ----------
    logs, mapping, force, on_findings
        As `models.identification.identify`.
    robot
        Robot file with known values of the robot: mass, wheel base, motors; shipped name or path.
    model
        Identified model to begin with and to compare with; by default SM is identified from the same rows.
    effects
        Whether to identify the effects of the base around that SM.
    seconds
        Duration of the log that is fitted [s]; by default that of the settings.
    name
        Name of the robot; by default from the logs.
    together
        Function that runs several drives of the plant.
    on_stage
        Called with the next step, and the approximate number of its drives.
    on_drive
        Called after each drive.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If an argument or a log cannot be used; the message is one line.
    """
    settings = twin_settings()
    announce = on_stage or (lambda _text, _count: None)
    if seconds is not None and not (np.isfinite(seconds) and seconds >= LEAST_SECONDS):
        raise ConfigError(f"--seconds {seconds:g}: give {LEAST_SECONDS:g} or more of the log to fit")
    if model is not None and effects:
        raise ConfigError("--effects: the model of --model has those of its file; give one of them")
    content = None if model is None else _content(model)
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
    beside = identified(content, join_experiments(experiments))
    gyro = data.yaw == "gyro"
    sensors = {"gyro.offset": 0.0, "encoders.delay": 0.0} | dict(beside.sensors)
    poses = pose_sensor(data.train, sensors) if gyro else None
    mount = dict(zip(poses.names, map(float, poses.values), strict=True)) if poses else None
    travel = mount["pose.travel"] if mount else 1.0
    nominal = nominal.clipping(beside.limits)
    space = space_of(nominal, beside.effects, gyro=gyro, lagging="encoders.lag" in beside.sensors, travel=travel)
    stretches = most_telling(join_experiments(experiments), beside.model.dc_gain, seconds or settings.seconds)
    problem = TwinProblem(space, stretches, together, on_drive or (lambda: None))
    fit = fit_twin(problem, beside.start(nominal), on_stage)
    announce("driving the rows held out", 1)
    held_out = sensor_experiments(data.validation, data.yaw)
    notes = [*_notes(beside), energy_note([*data.train, *data.validation])]

    def held(predictions: Sequence[HeldOutPrediction], metres: float) -> HeldOutScore:
        drift = drift_of(data.validation, predictions, mount, travel=metres, on_missing=notes.append)
        return HeldOutScore(fit_percent(predictions, held_out), drift, tuple(predictions))

    try:
        by_twin = held(hold_twin(fit, beside, held_out), 1.0)
    except RobotLostError as error:
        raise ConfigError(f"the fitted plant does not come through the rows held out: {error}") from error
    by_model = held(hold_model(beside, held_out), travel)
    return FittedTwin(
        title,
        data,
        fit,
        beside,
        content.name,
        by_twin,
        by_model,
        tuple(held_out),
        tuple(dict.fromkeys(notes)),
    )


def energy_note(records: Sequence[Record]) -> str:
    """Format the caveat on energies of drives with the plant: its motors' losses are those of the prior."""
    silent = all(record.motor_current is None and record.battery is None for record in records)
    why = "the log held no currents" if silent else "the currents of the log are not fitted"
    return (
        f"energy and power of a drive with this plant are the prior's and may be wrong several times over: {why}; "
        "compare drives by them, and plan no battery with them"
    )


def _content(model: str | Path) -> ModelFile:
    """Load the file of a linear model; raise ConfigError, or ModelError for a model that is a function."""
    load_linear_model(model)
    path = model_path(model)
    read_yaml(path)
    return read_model_file(path)


def _notes(beside: Identified) -> Sequence[str]:
    """List the parts of the identified model that the plant cannot have."""
    notes = []
    if beside.effects.yaw_relaxation is not None:
        notes.append(
            "twist of the tyres (yaw_relaxation) is not in the plant: contacts creep with time, not over an angle"
        )
    if beside.effects.wheel_command is not None:
        notes.append("steps, coasting and top speed of the wheels are those of the model; they are not fitted again")
    if np.isfinite(beside.limits).any():
        notes.append("the plant clips commands at the levels at which the model says that the robot does")
    delayed = [name for name in ("encoders.delay", "encoders.lag") if abs(beside.sensors.get(name, 0.0)) > 0.0]
    if delayed:
        notes.append("delay and lag of the log's encoders are fitted; the plant's own encoders are prompt")
    return notes
