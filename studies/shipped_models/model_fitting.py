"""Identification of the shipped models from the papers' experiments on the simulated robot.

The papers do not contain the coefficients of MBM and SM. The coefficients are therefore identified from drives of the
digital twin, and the parameter files state this source.
"""

from __future__ import annotations

import datetime
import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.optimize import minimize_scalar

from diffdrive_mpc.bench.report_folder import staged
from diffdrive_mpc.bench.run_row import model_name
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.identification.fit.pose_calibration import calibrate_lags
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import PARAMETERS, load_linear_model
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.named_file import read_editor_line
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, twist_experiments
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.validation import pooled_fit_percent, score
from diffdrive_mpc.models.robot import Positive, load_robot
from diffdrive_mpc.models.structures.channel import IdentifiedChannel, identify_channel
from diffdrive_mpc.models.structures.model_file import MbmFile, Motors, TwoPoles, build_model
from diffdrive_mpc.models.structures.two_delays import FROM_SM
from diffdrive_mpc.models.structures.two_poles import TwoPolesForm
from diffdrive_mpc.models.velocity_model import CHANNELS, VelocityModel
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc_extras.drives.drive_model import write_drive
from diffdrive_mpc_extras.drives.finding import drive_content
from diffdrive_mpc_extras.drives.fitting import fit_drive
from diffdrive_mpc_extras.networks.network import Architecture, fit_percent, split_windows, windows_of
from diffdrive_mpc_extras.networks.network_model import network_content, write_network
from diffdrive_mpc_extras.networks.training import method, train, training_settings
from studies.open_loop import OpenLoopDrive, drive_open_loop, random_commands, step_commands
from studies.reproduce.drive_models import EXPERIMENTAL, KINDS, PHYSICAL, twin_records
from studies.reproduce.drives import RobotLogs
from studies.reproduce.published import load_study


def side_difference(wheel_speeds: FloatArray, radius: float) -> FloatArray:
    """Compute right minus left rim speed [m/s] (K,) of wheel speeds (K, 4) [rad/s], averaged by side."""
    return np.asarray(0.5 * radius * (wheel_speeds @ np.array([-1.0, 1.0, -1.0, 1.0])))


def identify_track(difference: FloatArray, yaw_rate: FloatArray) -> float:
    """Identify the track [m] by least squares from right minus left rim speed (K,) [m/s] and yaw rate (K,) [rad/s].

    With the measured yaw rate, the result is the effective track, which is wider than the geometric track on a
    skid-steer robot. With the commanded yaw rate and settled wheels, the result is the firmware's track times the gain
    of the motors.

    Raises
    ------
    ValueError
        If the yaw rate is zero, or its sign is opposite to that of the difference.
    """
    energy = float(yaw_rate @ yaw_rate)
    slope = float(difference @ yaw_rate) / energy if energy > 0 else 0.0
    if slope <= 0:
        raise ValueError("track not identifiable: the yaw rate is zero or opposes the wheels; check its sign")
    # The gyro has the errors, so its yaw rate is regressed on the wheels: yaw rate = difference / track.
    return float(difference @ difference) / float(difference @ yaw_rate)


_SOURCE = (
    "digital twin of this project: mujoco plant, surface default, sensors default. Not from the paper, not from a robot"
)
_METHOD = (
    "output error (simulation from commands alone), two poles, no zeros, all experiments at once, dead time, scipy "
    "least_squares from several starts; wheel speeds divided by {scale:g} and dead time of v reduced by "
    "{lag:g} s, the gain and delay of the driver's observer relative to true poses"
)
_DEAD_TIMES = "; dead times from the steps of SM, because the firmware filters v and omega differently"


IDENTIFICATIONS = len(CHANNELS) + 2 * len(Motors.model_fields)
"""Total number of fitted transfer functions: both channels of SM, and each motor of MBM twice, see `_identify_mbm`."""

Identify = Callable[[str, list[SampledExperiment], float | None], IdentifiedChannel]
"""Function that identifies a channel from its name, its experiments, and its dead time [s] or None."""


class FittingSettings(StrictModel):
    """Settings of the identification from experiments; `model_fitting.yaml` describes each setting."""

    first_seed: int
    reading_seeds: tuple[int, ...]
    random_seeds: tuple[int, ...]
    validation_seeds: tuple[int, ...]
    settling_time: Positive
    min_short: Positive


@cache
def fitting_settings() -> FittingSettings:
    """Read `model_fitting.yaml`; raise ConfigError if it is invalid."""
    return load_checked(FittingSettings, Path(__file__).with_name("model_fitting.yaml"))


@dataclass(frozen=True)
class PaperExperiments:
    """Logs of the experiments of Guffanti et al., Sensors 2025, 25(11), 3553, on the simulated robot.

    The drives `random`, which are not in the paper, have set-points of both inputs, because a robot turns differently
    while driving than on the spot.
    """

    wheels: list[OpenLoopDrive]
    v: list[OpenLoopDrive]
    omega: list[OpenLoopDrive]
    random: list[OpenLoopDrive]


@cache
def wheel_reading() -> ParameterEstimate:
    """Identify delay [s] and gain [-] of the wheel speeds relative to the body from smoothed random drives."""
    drives = [
        drive_open_loop(make_plant("mujoco", seed=s), random_commands(s)) for s in fitting_settings().reading_seeds
    ]
    dt = load_robot().sample_time
    return calibrate_lags(
        [Record("", 0.0, dt, drive.command, twist=drive.wheel_twist, pose=drive.true_pose) for drive in drives]
    )


def _lag_and_scale() -> tuple[float, float]:
    """Return delay [s] and gain [-] of the wheel speeds with the digits of a configuration."""
    lag, scale = wheel_reading().values
    return round(float(lag), 4), round(float(scale), 4)


def _output_delays() -> tuple[float, float]:
    """Return the delays [s] of v from the encoders and omega from the gyro relative to the body."""
    return _lag_and_scale()[0], 0.0


def _scale_wheel_speeds(log: OpenLoopDrive) -> OpenLoopDrive:
    """Scale the wheel speeds of a drive to the speed over ground, without compensation of their delay."""
    _, scale = _lag_and_scale()
    return replace(log, wheel_speeds=log.wheel_speeds / scale, wheel_twist=log.wheel_twist / scale)


def run_experiments() -> PaperExperiments:
    """Drive the simulated robot with steps and random set-points; scale wheel speeds to the speed over ground."""
    seed = itertools.count(fitting_settings().first_seed)

    def logs(commands: Iterable[FloatArray]) -> list[OpenLoopDrive]:
        return [_scale_wheel_speeds(drive_open_loop(make_plant("mujoco", seed=next(seed)), rows)) for rows in commands]

    wheels, v, omega = (logs(step_commands(name)) for name in ("wheels", "v", "omega"))
    random = logs(random_commands(s, smooth=False) for s in fitting_settings().random_seeds)
    return PaperExperiments(wheels, v, omega, random)


def fit_models(
    folder: Path = PARAMETERS,
    date: datetime.date | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[Table, list[str]]:
    """Identify MBM, SM and the model with two delays, write their files, and return a table of their FIT and warnings.

    Parameters
    ----------
    folder
        Folder of the parameter files; by default the folder of the shipped files.
    date
        Date for the provenance; today by default.
    on_progress
        Function that is called with the number of fitted transfer functions and their total, first with 0.

    Raises
    ------
    models.checked_yaml.ConfigError
        If `folder` cannot be written to, which is checked before the experiments. After any error, its files are
        unchanged.
    """
    day = (date or datetime.date.today()).isoformat()
    announce = on_progress or (lambda _done, _total: None)
    count = itertools.count(1)

    def identify(label: str, experiments: list[SampledExperiment], dead_time: float | None) -> IdentifiedChannel:
        form = TwoPolesForm(min_short=fitting_settings().min_short)
        # The simulated sensors have no outliers, and the experiments are below all limits of the robot.
        channel = identify_channel(experiments, label, form=form, limit=False, robust=False, dead_time=dead_time)
        announce(next(count), IDENTIFICATIONS)
        return channel

    with staged(folder) as stage:
        announce(0, IDENTIFICATIONS)
        logs = run_experiments()
        sm, mbm = _identify_sm(logs, identify), _identify_mbm(logs, identify)
        lag, scale = _lag_and_scale()
        method = _METHOD.format(lag=lag, scale=scale)
        drives = logs.v + logs.random, logs.omega + logs.random
        _write(stage / "sm.yaml", sm, drives, (day, method), folder)
        _write(stage / "two_delays.yaml", _two_delays(sm), drives, (day, method + FROM_SM), folder)
        _write(stage / "mbm.yaml", mbm, (logs.wheels, logs.omega), (day, method + _DEAD_TIMES), folder)
    warnings = [f"{name}: {text}" for name, data in (("MBM", mbm), ("SM", sm)) for text in data["warnings"]]
    return validation_table(folder), warnings


def _write(
    path: Path,
    data: dict[str, Any],
    drives: tuple[list[OpenLoopDrive], list[OpenLoopDrive]],
    origin: tuple[str, str],
    previous_folder: Path,
) -> None:
    """Write a parameter file, load it, and add the FIT of the loaded model; `origin` is date and method.

    The first line for editors is copied from the file with this name in `previous_folder`.
    """
    name, line = path.stem, read_editor_line(previous_folder / path.name)
    data["provenance"] = {
        "origin": "identified",
        "source": _SOURCE,
        "method": origin[1],
        "experiments": [_describe_drives(logs, row) for row, logs in enumerate(drives)],
        "date": origin[0],
    }
    path.write_text(line + _yaml(name, data), encoding="utf-8")
    model = load_linear_model(path)
    data["fit_percent"] = {
        channel: round(_model_fit(model, logs, row), 2)
        for row, (channel, logs) in enumerate(zip(CHANNELS, drives, strict=True))
    }
    path.write_text(line + _yaml(name, data), encoding="utf-8")


def validation_table(folder: Path = PARAMETERS) -> Table:
    """Tabulate the FIT of the models on validation drives, and their delay relative to the body."""
    rows = []
    seeds = fitting_settings().validation_seeds
    for smooth in (True, False):
        drives = [
            _scale_wheel_speeds(drive_open_loop(make_plant("mujoco", seed=seed), random_commands(seed, smooth)))
            for seed in seeds
        ]
        for name in ("mbm", "sm", "ssm", "two_delays"):
            model = load_linear_model("ssm" if name == "ssm" else folder / f"{name}.yaml")
            fits = [_model_fit(model, drives, row) for row in (0, 1)]
            delays = [model_delay(model, drives, [log.true_twist[:, 2 * row] for log in drives], row) for row in (0, 1)]
            kind = "smoothed" if smooth else "stepwise"
            rows.append((model.name, kind, *(f"{x:.2f}" for x in fits), *(f"{x:.4f}" for x in delays)))
    (_, lag, lag_sd), (_, scale, scale_sd) = wheel_reading().rows
    return Table(
        title="Simulation FIT on random validation drives",
        columns=("model", "set-points", "FIT v [%]", "FIT omega [%]", "delay of v [s]", "delay of omega [s]"),
        rows=tuple(rows),
        text_columns=2,
        note="Delays are relative to the true twist of the body. Wheel speeds lag its poses by "
        f"{lag:.4f} +- {lag_sd:.4f} s; their gain is {scale:.4f} +- {scale_sd:.4f}.",
    )


def model_delay(model: VelocityModel, logs: list[OpenLoopDrive], motion: list[FloatArray], row: int) -> float:
    """Find the delay [s] of channel `row` of a model relative to the `motion` (K,) of each drive, for any gain."""
    simulated = [model.discretise(load_robot().sample_time).simulate(log.command)[:, row] for log in logs]
    true = np.concatenate(motion)

    def misfit(delay: float) -> float:
        pairs = zip(logs, simulated, strict=True)
        shifted = np.concatenate([np.interp(log.time + delay, log.time, predicted) for log, predicted in pairs])
        return float(np.sum((true - shifted * (true @ shifted) / (shifted @ shifted)) ** 2))

    return float(minimize_scalar(misfit, bounds=(-0.1, 0.1), method="bounded", options={"xatol": 1e-5}).x)


def _identify_sm(logs: PaperExperiments, identify: Identify) -> dict[str, Any]:
    fits = {}
    for row, (channel, steps) in enumerate(zip(CHANNELS, (logs.v, logs.omega), strict=True)):
        experiments = [_experiment(log, log.command[:, row], log.output[:, row]) for log in (*steps, *logs.random)]
        fits[channel] = identify(channel, experiments, None)
    return {
        "warnings": [str(warning) for fit in fits.values() for warning in fit.warnings],
        "dead_time": {
            channel: round(max(fit.parameters.value("dead_time") - delay, 0.0), 5)
            for delay, (channel, fit) in zip(_output_delays(), fits.items(), strict=True)
        },
        "channels": {channel: _round_content(fit) for channel, fit in fits.items()},
    }


def _two_delays(sm: Mapping[str, Any]) -> dict[str, Any]:
    poles = {name: TwoPoles.model_validate(channel) for name, channel in sm["channels"].items()}
    delays = {
        name: sm["dead_time"][name] + TwoPoles.lag([*channel.model_dump().values()]) for name, channel in poles.items()
    }
    return {
        "warnings": [],
        "dead_time": {name: round(time, 5) for name, time in delays.items()},
        "channels": {name: {"gain": channel.gain} for name, channel in poles.items()},
    }


def _identify_mbm(logs: PaperExperiments, identify: Identify) -> dict[str, Any]:
    robot = load_robot()

    def experiments(wheel: int) -> list[SampledExperiment]:
        return [
            _experiment(log, log.command[:, 0] / robot.wheel_radius, log.wheel_speeds[:, wheel]) for log in logs.wheels
        ]

    names = tuple(Motors.model_fields)
    # The command reaches all four motors over one link, so they share one dead time.
    separate_fits = [identify(name, experiments(wheel), None).parameters for wheel, name in enumerate(names)]
    shared = float(np.mean([parameters.value("dead_time") for parameters in separate_fits]))
    channels = [identify(name, experiments(wheel), shared) for wheel, name in enumerate(names)]
    difference = np.concatenate([side_difference(log.wheel_speeds, robot.wheel_radius) for log in logs.omega])
    gyro = np.concatenate([log.yaw_rate for log in logs.omega])
    commanded = np.concatenate([log.command[:, 1] for log in logs.omega])
    is_settled = np.concatenate([_settled_ticks(log) for log in logs.omega])
    gain = np.mean([channel.content["gain"] for channel in channels])
    content = {
        "warnings": [str(warning) for channel in channels for warning in channel.warnings],
        "dead_time": dict.fromkeys(CHANNELS, 0.0),
        "motors": {name: _round_content(channel) for name, channel in zip(names, channels, strict=True)},
        "wheel_radius": robot.wheel_radius,
        "firmware_track": round(identify_track(difference[is_settled], commanded[is_settled]) / float(gain), 5),
        "effective_track": round(identify_track(difference[is_settled], gyro[is_settled]), 5),
    }
    header = {"name": "MBM", "structure": "mbm", "provenance": {"origin": "identified", "source": _SOURCE}}
    undelayed_model = build_model(MbmFile.model_validate(content | header))
    delays = [
        -model_delay(undelayed_model, drives, [log.output[:, row] for log in drives], row) - delay
        for row, (drives, delay) in enumerate(zip((logs.v, logs.omega), _output_delays(), strict=True))
    ]
    return content | {"dead_time": {name: round(max(x, 0.0), 5) for name, x in zip(CHANNELS, delays, strict=True)}}


def _experiment(log: OpenLoopDrive, command: FloatArray, output: FloatArray) -> SampledExperiment:
    level = log.command[np.argmax(np.abs(log.command).sum(axis=1))]
    name = f"step to {level[0]:.3f} m/s, {level[1]:.3f} rad/s"
    mask = np.ones((len(output), 1), dtype=bool)
    return SampledExperiment(name, load_robot().sample_time, command[:, None], output[:, None], mask)


def _settled_ticks(log: OpenLoopDrive) -> FloatArray:
    """Return a mask (K,) of the samples of a motion whose command has been constant for the settling time."""
    window = round(fitting_settings().settling_time / load_robot().sample_time)
    changed = np.concatenate([[True], (np.diff(log.command, axis=0) != 0).any(axis=1)])
    recent = np.convolve(changed, np.ones(window))[: len(changed)]
    return np.asarray((recent == 0) & log.command.any(axis=1))


def _model_fit(model: VelocityModel, logs: list[OpenLoopDrive], row: int) -> float:
    discrete = model.discretise(load_robot().sample_time)
    delay = _output_delays()[row]
    simulated = [np.interp(log.time - delay, log.time, discrete.simulate(log.command)[:, row]) for log in logs]
    return pooled_fit_percent([log.output[:, row] for log in logs], simulated)


def _describe_drives(logs: list[OpenLoopDrive], row: int) -> str:
    steps = [log for log in logs if len(np.unique(log.command, axis=0)) <= 2]
    levels = [log.command[np.argmax(np.abs(log.command[:, row])), row] for log in steps]
    random = f", and {len(logs) - len(steps)} drives with random set-points" if len(logs) > len(steps) else ""
    return f"steps from rest to {', '.join(f'{level:.4g}' for level in levels)} {('m/s', 'rad/s')[row]}{random}"


def _round_content(channel: IdentifiedChannel) -> dict[str, float]:
    return {key: float(f"{value:.5g}") for key, value in channel.content.items()}


def _yaml(name: str, data: dict[str, Any]) -> str:
    head = "# By `python -m studies models fit`. Gains and damping [-], frequencies [rad/s], times [s], lengths [m].\n"
    body: dict[str, Any] = {
        "name": model_name(name),
        "structure": name,
        **{key: data[key] for key in ("provenance", "fit_percent", "warnings") if data.get(key)},
    }
    body |= {key: value for key, value in data.items() if key not in body and key != "warnings"}
    return head + yaml.safe_dump(body, sort_keys=False, allow_unicode=True, width=120, default_flow_style=None)


# The shipped drive models: Ivanjko et al., Modelling of Mobile Robot Dynamics, on the simulated robot.


_REPETITION = 43
"""Number of the repetition whose seeds the drives have; no study uses this number."""
_NOTES = {
    EXPERIMENTAL: "The structure is the paper's, whose Pioneer 3DX has two samples of 0.1 s and a lag of 0.1 s; its "
    "threshold's line and its slope limits are not in the text. All values are identified from the simulated robot. "
    "The gain is an addition of this project.",
    PHYSICAL: "The structure, K and T_A are the paper's. The gear ratio is not in the text, and the paper's I_0 is "
    "implausible. Mass, radius and track are those of the simulated robot. Logs of velocities determine only T_I and "
    "the ratios of K_R to the two inertias, so K_R and I_A follow from the mass, with I_0 = 0: with the rotors' "
    "inertia as I_0, I_A would be negative. I_A is less than half the inertia of the chassis, because the robot "
    "responds faster in yaw than in forward motion and the model has one controller for both wheels.",
}


def fit_drives(folder: Path) -> Table:
    """Fit the drive models to simulated drives, write their files to `folder`, and return a table of their FIT.

    The files are `p2_experimental.yaml` and `p2_physical.yaml`.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    train, held_out = twin_records(load_study().drive_models, _REPETITION)
    rows = []
    for name, kind in KINDS.items():
        fit = fit_drive(kind, train)
        scores = [score(fit.simulate(part), twist_experiments(part)).fit_percent for part in (train, held_out)]
        file = function_structures()[kind].name
        fields = {
            "name": f"P2 {name}",
            "provenance": {
                "origin": "identified",
                "source": "digital twin of this project: mujoco plant, default surface and sensors. Not from a robot",
                "method": "least squares on the free run, two starts, dead time in samples by descent",
                "experiments": [record.name for record in train],
                "date": date.today().isoformat(),
                "notes": _NOTES[name],
            },
            "fit_percent": _round_fit(scores[0]),
            "validation_fit_percent": _round_fit(scores[1]),
            "warnings": [
                f"{parameter} lies on a bound of the search: the data do not determine it" for parameter in fit.at_bound
            ],
        }
        write_drive(folder / f"{file}.yaml", drive_content(fit, fields))
        rows.append((name, *(f"{value:.2f}" for value in (*scores[0], *scores[1]))))
    columns = ("model", "FIT v [%]", "FIT omega [%]", "validation FIT v [%]", "validation FIT omega [%]")
    return Table("Drive models on drives of the simulated robot", columns, tuple(rows), text_columns=1)


def _round_fit(fit: FloatArray) -> dict[str, float]:
    """Round the FIT of v and omega to two decimal places [%]."""
    return {"v": round(float(fit[0]), 2), "omega": round(float(fit[1]), 2)}


# The shipped network is trained on a drive of the simulated robot. The network of P1 was trained on the real robot.


_NETWORK_FITTING_REPETITION = 41
"""Number of the repetition whose seeds the drives have; no study uses this number."""


def fit_network(folder: Path, on_progress: Callable[[int, int], None] | None = None) -> Table:
    """Train the paper's network on a drive of five minutes, write its files to `folder`, and return a table of its FIT.

    Raises
    ------
    models.errors.MissingPackageError
        If the package for the training is not installed.
    """
    announce = on_progress or (lambda *_: None)
    study, settings, architecture = load_study().ssm, training_settings(), Architecture()
    logs = RobotLogs(_NETWORK_FITTING_REPETITION)
    announce(0, 2)
    drive = logs.free(1, study.train_duration, study.paper_range)
    held_out = logs.free(study.free_drives, study.free_duration, study.paper_range)
    announce(1, 2)
    training, validation, test = split_windows(
        windows_of(twist_experiments(drive), architecture.window), settings.shares
    )
    result = train(architecture, training, validation, settings)
    network = result.network
    held_out_windows = windows_of(twist_experiments(held_out), architecture.window)
    parts = {"training": training, "validation": validation, "test": test, "other drives": held_out_windows}
    fits = {name: fit_percent(network, part) for name, part in parts.items()}
    content = network_content(
        network,
        name="LSTM",
        sample_time=drive[0].dt,
        fit_percent=_round_fit(fits["training"]),
        validation_fit_percent=_round_fit(fits["other drives"]),
        provenance={
            "origin": "identified",
            "source": "a free drive of the simulated robot (mujoco, default surface and sensors), as the experiment of "
            "Guffanti, Pavon, Sensors 2025, 25(18), 5821",
            "method": method(architecture, settings, result),
            "experiments": [record.name for record in drive],
            "date": date.today().isoformat(),
            "notes": "Architecture, optimiser and stopping rule are the paper's (Table 2, row 2); its weights and data "
            "are not public. The paper does not specify how the data were split, nor the learning rate. Validated on "
            "other drives of the same kind. The output at rest is subtracted from each output.",
        },
    )
    write_network(folder / "lstm.yaml", network, content)
    rows = [(name, str(len(parts[name])), *(f"{value:.2f}" for value in fit)) for name, fit in fits.items()]
    columns = ("part", "windows", "FIT v [%]", "FIT omega [%]")
    return Table("The network on drives of the simulated robot", columns, tuple(rows), text_columns=1)
