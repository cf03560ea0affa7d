"""The page of a commissioning: its steps, the delivered controller on the twin, the proof, the comparison."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from diffdrive_mpc.app.commission.commissioning import RESULT, TWIN_FILE, CommissionRequest
from diffdrive_mpc.app.commission.ledger import Done, steps_table
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.bench.html_report.document import picture
from diffdrive_mpc.bench.html_report.origin import origin
from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    ConfigurationView,
    EmbeddedPicture,
    KeyFigure,
    Page,
    RunViews,
    Series,
    Shown,
    Toggle,
    View,
    Warned,
)
from diffdrive_mpc.bench.html_report.run_series import run_series
from diffdrive_mpc.bench.html_report.run_warnings import run_warnings
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.table import Table, millis, number
from diffdrive_mpc.models.identification.deliver.configuration import CONFIG_FILE, MODEL_FILE, choose_pace
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.validation import validate
from diffdrive_mpc.models.structures.identified import model_file, write_model_file
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop, random_commands
from diffdrive_mpc.sim.plants.simulated_robot import load_simulated_robot
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.engine import CampaignPlace, drive_all
from diffdrive_mpc_extras.proof.study import told_of

# A controller that was given the true parameters of a simulated robot: what a commissioning is held against.


_SEEDS = (7000, 7001, 7002)
_SECONDS = 60.0


def write_informed(robot: Path, folder: Path) -> Path:
    """Write model and configuration of the informed controller into `folder`; gives the configuration's path.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If the robot file has a mistake, or the folder cannot be written to.
    """
    build = load_simulated_robot(robot)
    exact, records, motions, slopes = load_sensor_set("perfect"), [], [], []
    for seed in _SEEDS:
        plant = MujocoPlant(
            build.friction or 1.0, exact, seed, robot=build.robot, twin=build.twin, firmware=build.firmware
        )
        drive = drive_open_loop(plant, random_commands(seed, smooth=False, duration=_SECONDS))
        body = np.column_stack([drive.true_twist[:, 0], drive.wheel_twist[:, 1]])
        name = f"exact drive {seed}"
        records.append(Record(name, 0.0, plant.sample_time, drive.command, twist=body, yaw_rate=drive.true_twist[:, 2]))
        motions.append(drive.true_twist)
        slopes.append(np.gradient(drive.true_twist[:, 0], plant.sample_time))
    identified = identify_sm(records, limits=False)
    fit = validate(identified.system, records).fit_percent
    content = model_file(
        identified,
        name="true parameters",
        source=f"exact drives of {build.description}",
        records=[record.name for record in records],
        date=datetime.date.today(),
        train_fit_percent=fit,
        validation_fit_percent=fit,
        notes="scored on the drives that it is from",
    )
    (v, lateral, omega), slope = np.concatenate(motions).T, np.concatenate(slopes)
    side_slip, load_shift = np.linalg.lstsq(np.column_stack([-v * omega, slope * omega]), lateral, rcond=None)[0]
    pace = choose_pace(identified.model, records[0].dt)
    config = {
        "model": MODEL_FILE,
        "horizon": pace.horizon,
        "wheels": {"track": build.firmware.track, "encoder_track": build.robot.track},
        "estimator": {"side_slip": max(0.0, float(side_slip)), "load_shift": max(0.0, float(load_shift))},
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_model_file(folder / MODEL_FILE, content)
    path = folder / CONFIG_FILE
    path.write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    return path


# A commissioned controller beside the shipped one and one that was given the true parameters, on the robot itself.


PATHS = ("circle", "square", "s", "cane")
SEEDS = (70000, 70001, 70002)
"""Of the noise; nothing was commissioned, tuned or proven with them."""
SHIPPED, INFORMED, COMMISSIONED = "shipped", "true parameters", "commissioned"


@dataclass(frozen=True)
class ControllerComparison:
    """Position RMSE [m] over the paths' seeds, by controller and path."""

    errors: Mapping[str, Mapping[str, float]]

    def whole(self, controller: str) -> float:
        """Root mean square over all paths [m]."""
        return float(np.sqrt(np.mean(np.square(list(self.errors[controller].values())))))

    @property
    def over_informed(self) -> float:
        """Of the commissioned controller over the informed one [-]."""
        return self.whole(COMMISSIONED) / self.whole(INFORMED)

    @property
    def below_shipped(self) -> float:
        """By which share the commissioned controller is below the shipped one [-]."""
        return 1.0 - self.whole(COMMISSIONED) / self.whole(SHIPPED)

    def table(self) -> Table:
        """Errors, and their ratios to the informed controller's."""
        rows = []
        for name in (SHIPPED, COMMISSIONED, INFORMED):
            whole = self.whole(name)
            cells = [millis(self.errors[name][path]) for path in PATHS]
            rows.append((name, *cells, millis(whole), number(whole / self.whole(INFORMED), 2)))
        return Table(
            "On the robot itself",
            ("controller", *(f"{path} [mm]" for path in PATHS), "all [mm]", "over true parameters"),
            tuple(rows),
            1,
            f"Position RMSE over seeds {', '.join(map(str, SEEDS))}, all ticks together.",
        )


def compare(robot: Path, config: Path, shipped: str, folder: Path, jobs: int | None) -> ControllerComparison:
    """Drive the four paths on the robot with all three.

    Raises
    ------
    models.checked_yaml.ConfigError, bench.runner.StudyFailedError
        If something that is named cannot be used, or runs could not be driven.
    """
    controllers = {
        SHIPPED: told_of(shipped),
        COMMISSIONED: told_of(str(config)),
        INFORMED: told_of(str(write_informed(robot, folder / "informed"))),
    }
    plant = {"plant": f"mujoco:{robot.resolve()}"}
    runs = {
        (name, path): [Definition.of(dict(factors) | plant | {"trajectory": path, "seed": seed}) for seed in SEEDS]
        for name, factors in controllers.items()
        for path in PATHS
    }
    with ProgressBar("comparing") as bar:
        driven = drive_all(
            [definition for group in runs.values() for definition in group],
            CampaignPlace(folder, jobs),
            bar,
            "comparing",
        )
    results = iter(driven)
    errors: dict[str, dict[str, float]] = {name: {} for name in controllers}
    for (name, path), group in runs.items():
        values = [next(results).number("position_rmse_m") for _ in group]
        errors[name][path] = float(np.sqrt(np.mean(np.square(values))))
    return ControllerComparison(errors)


_FILES = {CONFIG_FILE: "Configuration for the robot", "model.yaml": "Model", TWIN_FILE: "Twin"}
_DRIVEN, _POINTS = ("circle", "s"), 400
_NEXT = (
    "The first drive: with config.yaml, on the robot's own floor, with room and a hand at the emergency stop, "
    "first_circle.yaml first. The proof is of the twin and of robots around it, not of this robot."
)


def commission_page(
    request: CommissionRequest,
    out: Path,
    steps: Mapping[str, Done],
    comparison: ControllerComparison | None,
    seconds: float,
) -> Page:
    """The page of the commissioning in `out`.

    Parameters
    ----------
    request
        What was asked for.
    out
        Its folder.
    steps
        What came of each step.
    found
        The comparison with the true parameters, where the robot is a drawn one.
    seconds
        How long the command took.
    """
    whole = all(step.passed for step in steps.values()) and (out / RESULT / CONFIG_FILE).is_file()
    runs = _on_the_twin(request, out) if whole else {}
    table = steps_table(steps, request.tuned)
    shown = Shown(
        summary=[_sentence(steps, whole), *([_NEXT] if whole else [])],
        key_figures=_key_figures(steps, runs, comparison, whole),
        toggles=[Toggle("path", tuple(runs), tuple(runs)[:1])] if runs else [],
        views=[*_views(out, runs), *([_compared(comparison)] if comparison else []), _cost(steps), *_proof(out)],
        warnings=_warnings(steps, out, runs),
        configurations=ConfigurationView.of_files(out / RESULT, _FILES),
    )
    tables = [table, *([comparison.table()] if comparison else [])]
    robot = [("robot", Path(request.robot).stem if request.robot else "a person drove it"), ("seed", str(request.seed))]
    return Page("diffdrive-mpc commission", "Commissioning", shown, tables, origin(describe_run(seconds), robot))


def _sentence(steps: Mapping[str, Done], whole: bool) -> str:
    if whole:
        return f"All {len(steps)} steps passed: model, configuration, twin and proof are in the folder “{RESULT}”."
    stopped = [name for name, step in steps.items() if not step.passed]
    return (
        f"It stopped at the step “{stopped[0]}”." if stopped else f"{len(steps)} steps are done, all of which passed."
    )


def _key_figures(
    steps: Mapping[str, Done], runs: Mapping[str, Run], comparison: ControllerComparison | None, whole: bool
) -> list[KeyFigure]:
    passed, cost = sum(step.passed for step in steps.values()), sum(step.processor_s for step in steps.values())
    made = [
        KeyFigure("steps passed", f"{passed} of {len(steps)}", "each gates the next", "good" if whole else "bad"),
        KeyFigure("processor time", f"{cost:.0f} s", "of all steps"),
    ]
    for path, run in runs.items():
        rmse = f"{1e3 * run.metrics.position_rmse_m:.1f} mm"
        made.append(KeyFigure(f"position error on the twin, {path}", rmse, "RMSE, with the delivered configuration"))
    if comparison is not None:
        side = "below" if comparison.below_shipped >= 0 else "above"
        less = f"{100 * abs(comparison.below_shipped):.0f} % {side} the shipped one"
        made.append(KeyFigure("error over that with true parameters", f"{comparison.over_informed:.2f}", less))
    return made


def _on_the_twin(request: CommissionRequest, out: Path) -> dict[str, Run]:
    """The delivered controller along some paths on the twin, by path."""
    place = out / RESULT
    config = str(place / CONFIG_FILE)
    plant = f"mujoco:{place / TWIN_FILE}"
    model = load_config(config).model
    return {
        path: run_case(Case(model=model, config=config, plant=plant, trajectory=path, scaled=request.scaled))
        for path in _DRIVEN
    }


def _views(out: Path, runs: Mapping[str, Run]) -> list[View]:
    if not runs:
        return []
    config = load_config(out / RESULT / CONFIG_FILE)
    series = [
        run_series(run, f"{path} on the twin", points=_POINTS, labels={"path": path}, config=config)
        for path, run in runs.items()
    ]
    note = "The delivered controller on the twin that was fitted to the robot's log. Point at either view."
    return [RunViews(series, note)]


def _compared(comparison: ControllerComparison) -> Chart:
    series = [
        Series(name, PATHS, [round(1e3 * comparison.errors[name][path], 2) for path in PATHS], i, "bars")
        for i, name in enumerate((SHIPPED, COMMISSIONED, INFORMED))
    ]
    return Chart("On the robot itself", Axis("path", "category"), Axis("position RMSE [mm]"), series)


def _cost(steps: Mapping[str, Done]) -> Chart:
    names, cost = list(steps), [round(step.processor_s, 1) for step in steps.values()]
    axes = Axis("step", "category"), Axis("processor time [s]")
    return Chart("What each step cost", *axes, [Series("processor time", names, cost, 0, "bars")])


def _proof(out: Path) -> list[View]:
    figures = sorted((out / "prove" / "figures").glob("*.png"))
    return [EmbeddedPicture(f"Proof: {path.stem.replace('-', ' ')}", picture(path), broad=False) for path in figures]


def _warnings(steps: Mapping[str, Done], out: Path, runs: Mapping[str, Run]) -> list[Warned]:
    warnings = [
        Warned(f"{name}: {step.sentence}.", f"what the step printed is in {name}/said.txt; mend it and call again")
        for name, step in steps.items()
        if not step.passed
    ]
    config = load_config(out / RESULT / CONFIG_FILE) if runs else None
    return warnings + [
        run_warning for path, run in runs.items() for run_warning in run_warnings(run, config, f"{path} on the twin")
    ]
