"""`python -m studies models fit`: the papers' experiments on the simulated robot, identified as MBM and SM.

Their coefficients are not in the papers' text, so they are identified from the digital twin, and the files say so.
"""

from __future__ import annotations

import datetime
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.optimize import minimize_scalar

from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.editor_line import kept_editor_line
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import PARAMETERS, load_linear_model
from diffdrive_mpc.models.logs.geometry import identify_track, side_difference
from diffdrive_mpc.models.output_error.experiment import Experiment
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.validation import pooled_fit_percent
from diffdrive_mpc.models.robot import Positive, load_robot
from diffdrive_mpc.models.structures.files import Motors, TwoPoles
from diffdrive_mpc.models.structures.two_poles import IdentifiedChannel, identify_channel
from diffdrive_mpc.models.velocity_model import CHANNELS, VelocityModel
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc.sim.plants.open_loop import Drive, drive_open_loop, random_commands, step_commands

_SOURCE = (
    "digital twin of this project: mujoco plant, surface default, sensors default. Not from the paper, not from a robot"
)
_METHOD = (
    "output error (simulation from commands alone), two poles, no zeros, all experiments at once, dead time, scipy "
    "least_squares from several starts"
)


IDENTIFICATIONS = len(CHANNELS) + 2 * len(Motors.model_fields)
"""Transfer functions that are fitted in all: both channels of SM, and each motor of MBM twice."""

Identify = Callable[[str, list[Experiment], float | None], IdentifiedChannel]
"""From the name of a channel, its experiments, and its dead time [s] where that is known, to what was found."""


class FittingSettings(StrictModel):
    """How the experiments are identified; the reasons stand in `model_fitting.yaml`."""

    first_seed: int
    validation_seeds: tuple[int, ...]
    settling_time: Positive
    shortest: Positive


@cache
def fitting_settings() -> FittingSettings:
    """Read `model_fitting.yaml`; raises ConfigError on a mistake in it."""
    return load_checked(FittingSettings, Path(__file__).with_name("model_fitting.yaml"))


@dataclass(frozen=True)
class PaperExperiments:
    """Logs of the experiments of Guffanti et al., Sensors 2025, 25(11), 3553, on the simulated robot."""

    wheels: list[Drive]
    v: list[Drive]
    omega: list[Drive]


def run_experiments() -> PaperExperiments:
    """Drive the simulated robot through the steps of the paper."""
    seed = itertools.count(fitting_settings().first_seed)

    def logs(commands: Iterable[FloatArray]) -> list[Drive]:
        return [drive_open_loop(make_plant("mujoco", seed=next(seed)), rows) for rows in commands]

    return PaperExperiments(logs(step_commands("wheels")), logs(step_commands("v")), logs(step_commands("omega")))


def fit_models(
    folder: Path = PARAMETERS,
    date: datetime.date | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[Table, list[str]]:
    """Identify MBM and SM, write `mbm.yaml` and `sm.yaml` to `folder`; return a table of their FIT, and warnings.

    Parameters
    ----------
    folder
        Where the parameter files go; the shipped ones by default.
    date
        Date for the provenance; today by default.
    on_progress
        Called with the number of transfer functions fitted so far and their total, at 0 and after each.

    Raises
    ------
    models.checked_yaml.ConfigError
        At once, if `folder` cannot be written to. Whatever goes wrong, its files stay as they were.
    """
    day = (date or datetime.date.today()).isoformat()
    announce = on_progress or (lambda _done, _total: None)
    count = itertools.count(1)

    def identify(label: str, experiments: list[Experiment], dead_time: float | None) -> IdentifiedChannel:
        shortest = fitting_settings().shortest
        # The simulated sensors have no outliers, and the experiments stay below every limit.
        found = identify_channel(experiments, label, limit=False, robust=False, dead_time=dead_time, shortest=shortest)
        announce(next(count), IDENTIFICATIONS)
        return found

    with staged(folder) as stage:
        announce(0, IDENTIFICATIONS)
        logs = run_experiments()
        sm, mbm = _fit_sm(logs, identify), _fit_mbm(logs, identify)
        _write(stage / "sm.yaml", sm, (logs.v, logs.omega), day, folder)
        _write(stage / "mbm.yaml", mbm, (logs.wheels, logs.omega), day, folder)
    warnings = [f"{name}: {text}" for name, data in (("MBM", mbm), ("SM", sm)) for text in data["warnings"]]
    return validation_table(folder), warnings


def _write(path: Path, data: dict[str, Any], used: tuple[list[Drive], list[Drive]], day: str, replaced: Path) -> None:
    """Write a parameter file, load it as a user would, and add the FIT of what was loaded.

    A file of the same name in the folder `replaced` keeps its line for editors.
    """
    name, line = path.stem, kept_editor_line(replaced / path.name)
    data["provenance"] = {
        "origin": "identified",
        "source": _SOURCE,
        "method": _METHOD,
        "experiments": [_describe(logs, row) for row, logs in enumerate(used)],
        "date": day,
    }
    path.write_text(line + _yaml(name, data), encoding="utf-8")
    model = load_linear_model(path)
    data["fit_percent"] = {
        channel: round(_model_fit(model, logs, row), 2)
        for row, (channel, logs) in enumerate(zip(CHANNELS, used, strict=True))
    }
    path.write_text(line + _yaml(name, data), encoding="utf-8")


def validation_table(folder: Path = PARAMETERS) -> Table:
    """FIT of the three models on drives that none was identified from."""
    rows = []
    seeds = fitting_settings().validation_seeds
    for smooth in (True, False):
        drives = [drive_open_loop(make_plant("mujoco", seed=seed), random_commands(seed, smooth)) for seed in seeds]
        for name in ("mbm", "sm", "ssm"):
            model = load_linear_model("ssm" if name == "ssm" else folder / f"{name}.yaml")
            fits = [_model_fit(model, drives, row) for row in (0, 1)]
            extra = best_extra_dead_time(model, drives)
            kind = "smoothed" if smooth else "in steps"
            rows.append((model.name, kind, *(f"{x:.2f}" for x in fits), *(f"{x:.4f}" for x in extra)))
    return Table(
        title="Simulation FIT on random drives that no model was identified from",
        columns=("model", "set-points", "FIT v [%]", "FIT omega [%]", "extra dead time v [s]", "omega [s]"),
        rows=tuple(rows),
        text_columns=2,
        note="Extra dead time: what each model's file lacks to explain these drives best.",
    )


def best_extra_dead_time(model: VelocityModel, logs: list[Drive]) -> FloatArray:
    """(2,) dead time [s] that the model's file does not carry and that would make it explain the logs best."""
    dt, extra = load_robot().sample_time, np.zeros(2)
    for row in (0, 1):

        def misfit(delay: float, row: int = row) -> float:
            candidate = model.with_extra_dead_time(np.eye(2)[row] * delay).discretise(dt)
            return float(sum(np.sum((log.output - candidate.simulate(log.command))[:, row] ** 2) for log in logs))

        extra[row] = minimize_scalar(misfit, bounds=(0.0, 0.1), method="bounded", options={"xatol": 1e-4}).x
    return extra


def _fit_sm(logs: PaperExperiments, identify: Identify) -> dict[str, Any]:
    fits = {}
    for row, (channel, used) in enumerate(zip(CHANNELS, (logs.v, logs.omega), strict=True)):
        experiments = [_experiment(log, log.command[:, row], log.output[:, row]) for log in used]
        fits[channel] = identify(channel, experiments, None)
    return {
        "warnings": [str(warning) for fit in fits.values() for warning in fit.warnings],
        "dead_time": {channel: round(fit.parameters.value("dead_time"), 5) for channel, fit in fits.items()},
        "channels": {channel: _rounded(fit.parameters) for channel, fit in fits.items()},
    }


def _fit_mbm(logs: PaperExperiments, identify: Identify) -> dict[str, Any]:
    robot = load_robot()

    def experiments(wheel: int) -> list[Experiment]:
        return [
            _experiment(log, log.command[:, 0] / robot.wheel_radius, log.wheel_speeds[:, wheel]) for log in logs.wheels
        ]

    names = tuple(Motors.model_fields)
    # The command reaches all four motors over one link: one dead time for all.
    alone = [identify(name, experiments(wheel), None).parameters for wheel, name in enumerate(names)]
    shared = float(np.mean([parameters.value("dead_time") for parameters in alone]))
    found = [identify(name, experiments(wheel), shared) for wheel, name in enumerate(names)]
    motors = [one.parameters for one in found]
    difference = np.concatenate([side_difference(log.wheel_speeds, robot.wheel_radius) for log in logs.omega])
    gyro = np.concatenate([log.yaw_rate for log in logs.omega])
    commanded = np.concatenate([log.command[:, 1] for log in logs.omega])
    settled = np.concatenate([_settled(log) for log in logs.omega])
    gain = np.mean([motor.value("gain") for motor in motors])
    return {
        "warnings": [str(warning) for one in found for warning in one.warnings],
        "dead_time": {channel: round(shared, 5) for channel in CHANNELS},
        "motors": {name: _rounded(motor) for name, motor in zip(names, motors, strict=True)},
        "wheel_radius": robot.wheel_radius,
        "firmware_track": round(identify_track(difference[settled], commanded[settled]) / float(gain), 5),
        "effective_track": round(identify_track(difference[settled], gyro[settled]), 5),
    }


def _experiment(log: Drive, command: FloatArray, output: FloatArray) -> Experiment:
    level = log.command[np.argmax(np.abs(log.command).sum(axis=1))]
    name = f"step to {level[0]:.3f} m/s, {level[1]:.3f} rad/s"
    every = np.ones((len(output), 1), dtype=bool)
    return Experiment(name, load_robot().sample_time, command[:, None], output[:, None], every)


def _settled(log: Drive) -> FloatArray:
    """(K,) whether the command has not changed for the settling time."""
    window = round(fitting_settings().settling_time / load_robot().sample_time)
    changed = np.concatenate([[True], (np.diff(log.command, axis=0) != 0).any(axis=1)])
    recent = np.convolve(changed, np.ones(window))[: len(changed)]
    return np.asarray((recent == 0) & log.command.any(axis=1))


def _model_fit(model: VelocityModel, logs: list[Drive], row: int) -> float:
    discrete = model.discretise(load_robot().sample_time)
    simulated = [discrete.simulate(log.command)[:, row] for log in logs]
    return pooled_fit_percent([log.output[:, row] for log in logs], simulated)


def _describe(logs: list[Drive], row: int) -> str:
    levels = [log.command[np.argmax(np.abs(log.command[:, row])), row] for log in logs]
    return f"steps from rest to {', '.join(f'{level:.4g}' for level in levels)} {('m/s', 'rad/s')[row]}"


def _rounded(channel: ParameterEstimate) -> dict[str, float]:
    return {key: float(f"{channel.value(key):.5g}") for key in TwoPoles.model_fields}


def _yaml(name: str, data: dict[str, Any]) -> str:
    head = "# By `python -m studies models fit`. Gains and damping [-], frequencies [rad/s], times [s], lengths [m].\n"
    body: dict[str, Any] = {
        "name": name.upper(),
        "structure": name,
        **{key: data[key] for key in ("provenance", "fit_percent", "warnings") if data.get(key)},
    }
    body |= {key: value for key, value in data.items() if key not in body and key != "warnings"}
    return head + yaml.safe_dump(body, sort_keys=False, allow_unicode=True, width=120, default_flow_style=None)
