"""The steps of a commissioning, each a function of a folder to write into and of what the steps before left."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.app.commission.ledger import DriveSettings, Gate, commission_settings
from diffdrive_mpc.app.identification.figures import draw_identification
from diffdrive_mpc.app.identification.trial_drives import FIRST_CIRCLE, first_circle
from diffdrive_mpc.app.identification.verdict import judge_by_drives
from diffdrive_mpc.bench.study import carry_out
from diffdrive_mpc.models.identification import Identification, identify
from diffdrive_mpc.models.identification.deliver.configuration import CONFIG_FILE, MODEL_FILE, Setting
from diffdrive_mpc.models.identification.fit.slip import lateral_slip
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.described import commented_yaml
from diffdrive_mpc.sim.log_csv import write_log
from diffdrive_mpc_extras.campaign.definition import stated
from diffdrive_mpc_extras.campaign.engine import CampaignPlace, failed
from diffdrive_mpc_extras.excitation.command import Excitation, check_drive, driven, excite_model, in_room
from diffdrive_mpc_extras.excitation.model_excitation import Room
from diffdrive_mpc_extras.proof.proof_file import Proof, load_proof
from diffdrive_mpc_extras.proof.report import Outcomes, is_unsafe, percent
from diffdrive_mpc_extras.proof.study import ProofStudy, keep
from diffdrive_mpc_extras.twin.study import twin_into

DRIVE, LOG = "drive.yaml", "log.csv"


@dataclass(frozen=True)
class Logs:
    """What was recorded: logs, and the mapping of their columns or topics; None for logs of the simulation."""

    files: tuple[Path, ...]
    mapping: str | None = None
    stated: str | None = None
    """Robot whose maker's statements bound the configuration."""


def excite(folder: Path, config: str, room: Room, settings: DriveSettings, seed: int) -> Gate:
    """Look for the drive; it must promise enough."""
    excitation = _excitation(config, room, settings, seed)
    excitation.write(folder / DRIVE)
    print(excitation.table())  # noqa: T201 - into the step's own file
    gates, expected = commission_settings().gates, excitation.expected
    late = expected.derived(
        CHANNELS, lambda values: np.array([values[1] + values[2], values[4] + values[5]])
    ).standard_deviation
    gain = [expected.deviation(f"{channel}.gain") for channel in CHANNELS]
    passed = bool(max(late) <= gates.delay_deviation and max(gain) <= gates.gain_deviation)
    words = (
        f"a drive of {settings.seconds:g} s in {room.length:g} by {room.width:g} m, up to {settings.speed:g} m/s, will "
        f"tell how late v and omega answer to {1e3 * late[0]:.1f} and {1e3 * late[1]:.1f} ms, and their gains to "
        f"{100 * max(gain):.2f} %"
    )
    return Gate(passed, words if passed else f"{words}: too little; give more room or time")


def record(folder: Path, config: str, room: Room, drive: Path, plant: str, seed: int) -> Gate:
    """Drive it on a simulated robot, in the fence of the room."""
    run = driven(replace(in_room(config, room), plant=plant, seed=seed), drive)
    try:
        check_drive(run, room)
    except ValueError as error:
        return Gate(False, f"{error}")
    # How long a step took differs when it is driven again, and what follows would be done again, too.
    unknown = np.full(len(run.time), np.nan)
    write_log(run.with_step_time(unknown, unknown), folder / LOG)
    inside = float((0.5 * np.array([room.length, room.width]) - np.abs(run.true_pose[:, :2]).max(axis=0)).min())
    return Gate(True, f"{len(run.time)} rows; the robot stayed {inside:.2f} m inside the room")


def take(folder: Path, logs: Logs) -> Gate:
    """Take the logs that a person recorded."""
    rows = 0
    for log in logs.files:
        read = read_log(log, logs.mapping)
        read.require_sound()
        rows += sum(len(one.command) for one in read.records)
        (shutil.copytree if log.is_dir() else shutil.copy2)(log, folder / log.name)
    return Gate(True, f"{rows} rows, sound")


def learn(folder: Path, logs: Logs, config: str) -> Gate:
    """From the slow log to a configuration for the full drive: its model, otherwise what the first drive had."""
    identification = identify(logs.files, logs.mapping, structure="sm", robot=logs.stated)
    identification.write(folder)
    gate = _explained(identification)
    if not gate.passed:
        return gate
    changes = {"model": MODEL_FILE, "extra_dead_time": {}, "horizon": identification.config["horizon"]}
    changed = replace_values(load_config(config), changes)
    (folder / CONFIG_FILE).write_text(commented_yaml(changed), encoding="utf-8")
    return gate


def identify_all(folder: Path, logs: Logs) -> Gate:
    """Identify from all logs, with where the filter may begin; the configuration must drive."""
    identification = _with_slip(identify(logs.files, logs.mapping, structure="sm", robot=logs.stated), logs)
    gate = _explained(identification)
    verdict = judge_by_drives(identification) if gate.passed else None
    identification = verdict.identification if verdict else identification
    identification.write_report(folder, draw_identification(identification.report, folder, lambda: None))
    if verdict is None:
        return gate
    if verdict.config is None or verdict.against:
        return Gate(False, f"{gate.sentence}, but {verdict.against}")
    identification.write_model(folder)
    circle = first_circle(verdict.config, identification.model)
    (folder / FIRST_CIRCLE).write_text(circle.text(), encoding="utf-8")
    words = f"with its configuration {len(verdict.drives)} trial drives stay on their paths"
    return Gate(True, "; ".join([gate.sentence, words, *verdict.changed]))


def twin(folder: Path, logs: Logs, robot: str | None, jobs: int | None, seconds: float) -> Gate:
    """Fit the physics to the full log; it must explain nearly as much as the model."""
    fitted = twin_into(logs.files, folder, jobs=jobs, mapping=logs.mapping, robot=robot, seconds=seconds)
    gates = commission_settings().gates
    mine, model = fitted.twin_held.fit_percent, fitted.model_held.fit_percent
    words = "the twin explains " + " and ".join(
        f"{mine[name]:.0f} % of {name} (the model {model[name]:.0f} %)" for name in CHANNELS
    )
    passed = all(mine[name] >= max(gates.fit, model[name] - gates.twin_behind) for name in CHANNELS)
    return Gate(passed, words if passed else f"{words}: too little; say what is known of the robot with --known")


def prove(folder: Path, config: Path, plant: Path, runs: int, jobs: int | None, *, scaled: bool) -> Gate:
    """Drive the configuration on twins around the fitted one: no unsafe command, and all runs without faults arrive."""
    settings = commission_settings().proof
    proof = twin_proof(plant, runs, scaled=scaled)
    study = ProofStudy(str(config), proof, CampaignPlace(folder, jobs), runs, settings.worst)
    proven = carry_out(study, folder, jobs)
    keep(proven, folder)
    of = Outcomes.of(proven.driven, proof.band)
    calm = [run for run in proven.driven if run.definition.case.scenario == "none"]
    arrived = sum(one.row["completed"] is True for one in calm)
    words = (
        f"{of.unsafe.count} of {of.unsafe.of} runs had an unsafe command (with 95 % confidence fewer than "
        f"{percent(of.unsafe.bound)} % of all such runs), {arrived} of {len(calm)} without a fault arrived, "
        f"{of.completed.count} of all"
    )
    wrong = failed(proven.driven)
    passed = not any(map(is_unsafe, proven.driven)) and arrived == len(calm) and not wrong
    return Gate(passed, f"{words}; {wrong}" if wrong else words)


def twin_proof(plant: Path, runs: int, *, scaled: bool = False) -> Proof:
    """The shipped proof's paths, faults and pose sensors, on robots around a twin."""
    settings, shipped = commission_settings().proof, load_proof(None)
    factors: dict[str, Any] = {
        name: value for name, value in shipped.factors.items() if name.partition(".")[0] not in ("robot", "surface")
    }
    factors |= {"plant": f"mujoco:{plant.resolve()}", "seed": {"each": settings.first_seed}}
    if scaled:
        factors["scaled"] = True
    for name, (low, high) in settings.spread.items():
        value = stated(name, factors)
        factors[name] = {"uniform": [low * value, high * value]}
    from_twin = {
        "description": "the fitted twin, robots around it, pose sensors and faults",
        "runs": runs,
        "factors": factors,
    }
    return Proof.model_validate({"draw_seed": shipped.draw_seed, "sampler": shipped.sampler} | from_twin)


def _excitation(config: str, room: Room, settings: DriveSettings, seed: int) -> Excitation:
    return excite_model(
        config, room, seconds=settings.seconds, speed=settings.speed, yaw_rate=settings.yaw_rate, seed=seed
    )


def _explained(identification: Identification) -> Gate:
    """What the model explains of the data held out."""
    fit, least = identification.report.fitted.validation.fit_percent, commission_settings().gates.fit
    words = "the model explains " + " and ".join(
        f"{value:.0f} % of {name}" for name, value in zip(CHANNELS, fit, strict=True)
    )
    if identification.refusal or not min(fit) >= least:
        return Gate(False, f"{words} on data held out, less than {least:g} %: look at said.txt and report.md")
    return Gate(True, f"{words} on data held out")


def _with_slip(identification: Identification, logs: Logs) -> Identification:
    """The same, its configuration with the sideways slip that the logs show, where they do."""
    records = [record for log in logs.files for record in read_log(log, logs.mapping).records]
    slip = lateral_slip(records)
    if slip is None:
        return identification
    settings = []
    bounds = commission_settings().most_slip
    for name, most, unit in (("side_slip", bounds.side_slip, "s"), ("load_shift", bounds.load_shift, "s^2")):
        value, deviation = slip.value(name), slip.deviation(name)
        if deviation < value < most:
            reason = f"{unit}, from poses and gyro of the log; standard deviation {deviation:.2g}"
            settings.append(Setting(name, float(f"{value:.3g}"), reason))
    whole = replace(identification.configuration, estimator=(*identification.configuration.estimator, *settings))
    return replace(identification, configuration=whole, config=whole.mapping())


def tuned(folder: Path, config: Path, plant: Path, plan: str | None, jobs: int | None) -> Gate:
    """Tune on the twin; what is no better leaves the configuration as it was."""
    from diffdrive_mpc.app.tune import study  # noqa: PLC0415 - needs the extra `tune`

    return Gate(True, study.tune(config, folder, plan=plan, plant=plant, jobs=jobs).sentence)
