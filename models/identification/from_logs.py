"""Identification of a robot from logs: model, controller configuration and report."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import checked_call, wrong_type
from diffdrive_mpc.models.identification.advice import Advice, AdvisedError, LogSelection, advise, drop_rejected
from diffdrive_mpc.models.identification.deliver.configuration import (
    CONFIG_FILE,
    MODEL_FILE,
    NODE_FILE,
    IdentifiedConfiguration,
    apply_stated_values,
    configure,
    node_text,
    round_period,
)
from diffdrive_mpc.models.identification.deliver.report import IdentificationReport
from diffdrive_mpc.models.identification.deliver.trust import refusals
from diffdrive_mpc.models.identification.fit.fitting import fit, with_predictor
from diffdrive_mpc.models.identification.fit.poses import from_poses
from diffdrive_mpc.models.identification.fit.predictor import Predictor, finders
from diffdrive_mpc.models.identification.fit.sensors import find_corrections
from diffdrive_mpc.models.identification.fit.slip import SURFACE_FILE, log_surface, slip_prior, surface_text
from diffdrive_mpc.models.identification.log_data import LogData, OptionError, read_data
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.logs import Finding, Log
from diffdrive_mpc.models.logs.bags import is_bag
from diffdrive_mpc.models.logs.drive_log.reader import is_drive_log
from diffdrive_mpc.models.logs.record import UnsoundLogError
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.stated_robot import ManufacturerRobot, load_stated_robot
from diffdrive_mpc.models.structures.identified import model_file, percent, provenance, write_model_file
from diffdrive_mpc.models.structures.model_file import ModelFile, build_model
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.structures.structure import Structure
from diffdrive_mpc.models.suggestions import similar_name
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.models.whole_file import reason

if TYPE_CHECKING:
    from pandas import DataFrame

AUTOMATIC = "auto"
ACCOMPANYING = "sm"
"""Structure of the linear model that accompanies a predictor."""
FILES = (MODEL_FILE, CONFIG_FILE, SURFACE_FILE, NODE_FILE, "report.json", "report.md")
"""Files that `Identification.write` writes; the node's parameters only for bags. A network also has a weights file."""


@dataclass(frozen=True, eq=False, repr=False)
class Identification:
    """Result of an identification from logs. `str` returns the report's summary; arrays are read-only.

    Attributes
    ----------
    model
        Velocity model, for `Controller(..., model=identification.model)`.
    config
        Keys and values for `load_config`: limits that the logs cover, tracks of the wheels, and the name of the model
        file, which `write` stores in the folder of the configuration.
    surface
        Keys and values of a surface file with the slip of the log, for a simulated plant with the model.
    report
        Scores, parameters with uncertainty, and warnings, as data, JSON (`as_json`), Markdown and tables.
    content
        Content of the model's parameter file.
    configuration
        Values of `config`, each with a reason.
    """

    model: VelocityModel | NonlinearModel
    config: Mapping[str, Any]
    surface: Mapping[str, Mapping[str, float]]
    report: IdentificationReport
    content: Any
    configuration: IdentifiedConfiguration

    def __repr__(self) -> str:
        """Format the name only, without arrays."""
        return f"<Identification {self.report.name!r}>"

    def __str__(self) -> str:
        """Format the summary of the report."""
        return str(self.report)

    @property
    def verdict(self) -> str:
        """Verdict on the model in one line."""
        return self.report.verdict

    @property
    def advice(self) -> Advice | None:
        """Mapping that improves the prediction of the logs; None if no proposed mapping improves it."""
        return self.report.data.advice

    @property
    def refusal(self) -> str:
        """Reasons in one line why no controller should use this model; empty if the model is usable."""
        return "; ".join(refusals(self.report.data.findings, self.report.fitted))

    def write(self, folder: str | Path, figures: Mapping[str, str] | None = None, *, force: bool = False) -> None:
        """Write `FILES` to `folder`; create the folder if it is missing, and replace existing files.

        If `refusal` is not empty, model, configuration and surface are written only with `force`. The mapping of
        `advice` is also written.

        Parameters
        ----------
        folder
            Target folder.
        figures
            Relative paths of the figures of the report, by title.
        force
            True to write model, configuration and surface despite a `refusal`.

        Raises
        ------
        ConfigError, OSError
            If the folder or a file cannot be written.
        """
        if force or not self.refusal:
            self.write_model(folder)
        self.write_report(folder, figures)

    def write_model(self, folder: str | Path) -> None:
        """Write model, configuration, surface and, for bags, the node's parameters to `folder`."""
        folder, predictor = _make_folder(folder), self.report.fitted.predictor
        if predictor is None:
            write_model_file(folder / MODEL_FILE, self.content)
        else:
            predictor.write(folder / MODEL_FILE, self.content)
        (folder / CONFIG_FILE).write_text(self.configuration.text(), encoding="utf-8")
        (folder / SURFACE_FILE).write_text(surface_text(self.surface), encoding="utf-8")
        if self.report.data.topics:
            (folder / NODE_FILE).write_text(node_text(self.report.data.topics), encoding="utf-8")

    def write_report(self, folder: str | Path, figures: Mapping[str, str] | None = None) -> None:
        """Write the report as Markdown and JSON, and the mapping of `advice`, to `folder`."""
        text = self.report.markdown(figures)
        data = json.dumps(self.report.as_json(), indent=1, allow_nan=False) + "\n"
        folder = _make_folder(folder)
        if self.advice:
            self.advice.write(folder)
        (folder / "report.json").write_text(data, encoding="utf-8")
        (folder / "report.md").write_text(text, encoding="utf-8")


@checked_call(out="write the result: identify(...).write(FOLDER)")
def identify(
    logs: str | Path | DataFrame | Sequence[str | Path | DataFrame],
    mapping: str | Path | None = None,
    structure: str = "sm",
    effects: bool = False,
    *,
    robot: str | Path | None = None,
    validate: str | Path | DataFrame | Sequence[str | Path | DataFrame] = (),
    fit_share: float | None = None,
    order: int | str = AUTOMATIC,
    name: str | None = None,
    force: bool = False,
    on_log: Callable[[Log], None] | None = None,
    on_findings: Callable[[Sequence[Finding]], None] | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> Identification:
    """Identify a velocity model from logs, and grade it.

    Parameters
    ----------
    logs
        CSV files, ROS 2 bags or data frames of pandas, all of one robot.
    mapping
        Mapping of columns or topics: name of a shipped mapping or path of a mapping file. None for logs of
        `diffdrive-mpc simulate --log`, and for bags with the default topics.
    structure
        "mbm", "mbm_modes", "sm", "ssm"; "p2_experimental" or "p2_physical", a drive model; "lstm", a network trained on
        the logs; or "hybrid", an sm with a small network for its residuals. Both networks need the extra `learn` and
        take minutes.
    effects
        True to identify base effects in addition to an sm: slew, steps, tyres, veer. Takes minutes.
    robot
        Name of a robot, or path of a file, with values from the manufacturer: topics of bags without `mapping`, limits,
        track and footprint. These values are used if the logs do not determine them.
    validate
        Validation logs; by default the last part of each of `logs`.
    fit_share
        Share of each log for the identification, if there are no validation logs [-]; by default 0.6.
    order
        Order of an ssm, or "auto" to select it.
    name
        Name of the model; by default derived from the logs.
    force
        True to continue if logs have errors: wrong units, dead wheels, channels that are never driven.
    on_log
        Function that is called with each log after it is read, before the fit.
    on_findings
        Function that is called with notes and warnings of the logs after proposals for the mapping are tried, even if
        an error follows.
    on_progress
        Function that is called with a description of the next step.

    Raises
    ------
    models.identification.advice.AdvisedError
        If a log leads to a wrong model; `advice` is the mapping that corrects the log, or None.
    models.checked_yaml.ConfigError, ValueError, OSError
        If an argument or a log cannot be used, or no model can be fitted to the logs; the message is one line.
    """
    selected_structure, predictor = _choose_structure(structure, effects=effects)
    checked_order = _check_order(selected_structure, order)
    if name is not None and not (isinstance(name, str) and name.strip()):
        raise OptionError("name", f": {name!r} is not a name; pass a text, or omit the option")
    share = identification_settings().fit_share if fit_share is None else fit_share
    stated_robot = None if robot is None else load_stated_robot(robot)
    with TemporaryDirectory(prefix="diffdrive-mpc-") as folder, _frames_by_name(folder):
        paths = _paths(logs, Path(folder), "data frame")
        if not paths:
            raise ConfigError("no logs: pass at least one log")
        if on_progress:
            on_progress("reading")
        # Recordings of the node have fixed topic names.
        is_robot_bag = is_bag(paths[0]) and not is_drive_log(paths[0])
        effective_mapping = (
            stated_robot.mapping() if stated_robot is not None and mapping is None and is_robot_bag else mapping
        )
        validation_paths = _paths(validate, Path(folder), "validation data frame")
        if validation_paths and fit_share is not None:
            rest = ": with --validate, all rows of the other logs are training data; pass only one of the options"
            raise OptionError("fit_share", rest)
        selection = LogSelection(tuple(paths), tuple(validation_paths), effective_mapping, share)
        log_findings: list[Finding] = []
        report = on_findings or (lambda _: None)
        try:
            data = read_data(
                selection.logs,
                selection.validate,
                mapping=effective_mapping,
                fit_share=share,
                wheels=selected_structure.needs_wheels,
                on_findings=log_findings.extend,
                on_log=on_log,
                force=force,
                max_rows=identification_settings().max_rows["effects" if effects else "plain"],
            )
        except (ValueError, OSError) as error:
            if not isinstance(error, UnsoundLogError):
                report(log_findings)
                raise
            advice = advise(selection, error.findings, on_progress)
            report(drop_rejected(log_findings, advice))
            raise AdvisedError(error.findings, advice) from error
        corrections = find_corrections(data.logs[0], data.train, effective_mapping)
        findings = corrections.merged(data.findings)
        advice = advise(selection, findings, on_progress)
        report(drop_rejected(corrections.merged(log_findings), advice))
    data = replace(
        data,
        train=corrections.correct(data.train),
        validation=corrections.correct(data.validation),
        findings=drop_rejected(findings, advice),
        sensors=corrections.settings,
        advice=advice,
    )
    suffix = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
    title = name or f"{structure.upper()} from {paths[0].stem}{suffix}"
    return identify_data(
        data,
        selected_structure,
        title,
        order=checked_order,
        effects=effects,
        predictor=predictor,
        robot=stated_robot,
        on_progress=on_progress,
    )


def identify_data(
    data: LogData,
    structure: Structure,
    name: str,
    *,
    order: int | None = None,
    effects: bool = False,
    predictor: str | None = None,
    robot: ManufacturerRobot | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> Identification:
    """Identify a model from records that are already divided into training and validation data.

    Parameters
    ----------
    data
        Training and validation records, which become read-only.
    structure
        Structure of the model.
    name
        Name of the model.
    order, effects, on_progress
        Arguments as in `identify`; the order None selects the order automatically.
    predictor
        Key of `finders`. This finder identifies an additional model, which predicts; the model of `structure` then
        determines limits and tracks.
    robot
        Robot with values from the manufacturer, which bound the configuration and replace values that the logs do not
        determine.

    Raises
    ------
    ValueError
        If the records are unsuitable.
    """
    progress = on_progress or (lambda _: None)
    progress("identification (seconds, up to minutes)")
    fitted = fit(
        data, structure, order, effects=effects, on_trial=lambda effect: progress(f"trial of the effect: {effect}")
    )
    if predictor:
        progress(f"{predictor} (a minute or more)")
        fitted = with_predictor(data, fitted, finders()[predictor]())
    poses = from_poses(data, fitted)
    slip = slip_prior(poses.at_rotation_centre([*data.train, *data.validation]))
    report = IdentificationReport(name, data, fitted, poses, slip, date.today(), robot)
    configuration = configure(
        name,
        fitted.identified,
        data.train,
        fitted.geometry,
        report.slip,
        validation=data.validation,
        mapping_track=data.stated_track,
        keep_sample_time=predictor is not None,
        sensors=data.sensors,
        notes=tuple(finding.message for finding in data.findings if finding.kind == "no heading"),
    )
    if robot is not None:
        configuration = apply_stated_values(configuration, robot)
    model: VelocityModel | NonlinearModel
    content: Any
    if fitted.predictor is None:
        content = _linear_model_content(report)
        model = build_model(content)
    else:
        content = fitted.predictor.content(_fields(report, fitted.predictor))
        model = fitted.predictor.model(content)
    surface = log_surface(data.train, report.slip)
    identification = Identification(model, configuration.mapping(), surface, report, content, configuration)
    _make_read_only(identification)
    return identification


def _make_folder(folder: str | Path) -> Path:
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written to ({reason(error)}); choose another folder") from error
    return Path(folder)


@contextmanager
def _frames_by_name(folder: str) -> Iterator[None]:
    """Remove the temporary folder of data frames from error messages."""
    try:
        yield
    except ConfigError as error:
        if folder not in (message := str(error)):
            raise
        remedy = "; first write the data frame to this file: frame.to_csv('data frame 0', index=INDEX), INDEX is "
        remedy += "True for an index with a name, otherwise False"
        raise ConfigError(message.replace(f"{folder}/", "") + remedy * ("--draft" in message)) from error


def _paths(logs: object, folder: Path, name: str) -> list[Path]:
    """Return the paths of the logs; write data frames to CSV files in `folder`, with names that start with `name`.

    An index with a name, such as the time, becomes a column.
    """
    items = logs if isinstance(logs, (list, tuple)) else [logs]
    paths = []
    for number, log in enumerate(items):
        if hasattr(log, "to_csv"):
            paths.append(folder / f"{name} {number}")
            log.to_csv(paths[-1], index=log.index.name is not None)
        elif isinstance(log, (str, Path)):
            paths.append(Path(log))
        else:
            remedy = "convert arrays to a pandas.DataFrame, and name its columns in a mapping"
            raise wrong_type("logs", "paths of log files or data frames", log, remedy)
    return paths


def _linear_model_content(report: IdentificationReport) -> ModelFile:
    fitted = report.fitted
    return model_file(
        fitted.identified,
        name=report.name,
        train_fit_percent=fitted.train.fit_percent,
        validation_fit_percent=fitted.validation.fit_percent,
        **_origin(report),
    )


def _fields(report: IdentificationReport, predictor: Predictor) -> dict[str, Any]:
    """Return the fields that are common to the parameter files of all predictors."""
    fitted, data = report.fitted, report.data
    return {
        "name": report.name,
        "sample_time": round_period(data.train[0].dt),
        "limits": fitted.identified.limits or None,
        "warnings": [str(doubt) for doubt in report.doubts],
        "fit_percent": percent(fitted.train.fit_percent),
        "validation_fit_percent": percent(fitted.validation.fit_percent),
        "provenance": provenance(f"{predictor.method}; omega of the {data.yaw}", **_origin(report)),
    }


def _origin(report: IdentificationReport) -> dict[str, Any]:
    """Return the part of the provenance in a model file that depends on the logs."""
    data = report.data
    return {
        "source": ", ".join(data.logs),
        "records": [record.name for record in data.train],
        "date": report.day,
        "notes": f"validated on {data.held_out}",
    }


def _choose_structure(name: str, *, effects: bool) -> tuple[Structure, str | None]:
    """Return the structure `name` and None; for a predictor, return the accompanying structure and `name`.

    Raise OptionError if the options are incompatible, and MissingPackageError if the predictor's package is missing.
    """
    predictor = name if name in finders() else None
    if predictor is None and name not in STRUCTURES:
        names = (*STRUCTURES, *finders())
        raise OptionError("structure", f" '{name}': give one of {', '.join(names)}{similar_name(name, names)}")
    selected_structure = STRUCTURES[ACCOMPANYING if predictor else name]
    if effects and (predictor or not selected_structure.supports_effects):
        supported = " or ".join(structure.name for structure in STRUCTURES.values() if structure.supports_effects)
        raise OptionError("effects", f": structure {name} has no effects; choose {supported}")
    if predictor:
        finders()[predictor]()
    return selected_structure, predictor


def _check_order(structure: Structure, order: int | str) -> int | None:
    if order == AUTOMATIC:
        return None
    if structure.max_order is None:
        supported = " or ".join(name for name, candidate in STRUCTURES.items() if candidate.max_order is not None)
        raise OptionError("order", f" {order}: only {supported} has a selectable order; omit it for {structure.name}")
    if not (str(order).isdecimal() and 1 <= int(order) <= structure.max_order):
        raise OptionError("order", f" '{order}': give {AUTOMATIC}, or 1 to {structure.max_order}")
    return int(order)


def _make_read_only(value: object) -> None:
    """Make every array in nested dataclasses, tuples, lists and mappings read-only."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            _make_read_only(getattr(value, field.name))
    elif isinstance(value, (tuple, list)):
        for part in value:
            _make_read_only(part)
    elif isinstance(value, Mapping):
        for part in value.values():
            _make_read_only(part)
