"""The page of a commissioning: its steps, the delivered controller on the twin, the proof, the comparison."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from diffdrive_mpc.app.commission.commissioning import RESULT, TWIN_FILE, Asked
from diffdrive_mpc.app.commission.comparison import COMMISSIONED, INFORMED, PATHS, SHIPPED, Comparison
from diffdrive_mpc.app.commission.ledger import Done
from diffdrive_mpc.app.commission.report import steps_table
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.bench.html_report.document import picture
from diffdrive_mpc.bench.html_report.origin import origin
from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    Configuration,
    KeyFigure,
    Page,
    Picture,
    Runs,
    Series,
    Shown,
    Toggle,
    View,
    Warned,
)
from diffdrive_mpc.bench.html_report.run_series import run_series
from diffdrive_mpc.bench.html_report.run_warnings import run_warnings
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.models.identification.configuration import CONFIG_FILE
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.sim import Run

_FILES = {CONFIG_FILE: "Configuration for the robot", "model.yaml": "Model", TWIN_FILE: "Twin"}
_DRIVEN, _POINTS = ("circle", "s"), 400
_NEXT = (
    "The first drive: with config.yaml, on the robot's own floor, with room and a hand at the emergency stop, "
    "first_circle.yaml first. The proof is of the twin and of robots around it, not of this robot."
)


def commission_page(
    asked: Asked, out: Path, steps: Mapping[str, Done], found: Comparison | None, seconds: float
) -> Page:
    """The page of the commissioning in `out`.

    Parameters
    ----------
    asked
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
    whole = all(one.passed for one in steps.values()) and (out / RESULT / CONFIG_FILE).is_file()
    runs = _on_the_twin(asked, out) if whole else {}
    table = steps_table(steps, asked.tuned)
    shown = Shown(
        summary=[_sentence(steps, whole), *([_NEXT] if whole else [])],
        key_figures=_key_figures(steps, runs, found, whole),
        toggles=[Toggle("path", tuple(runs), tuple(runs)[:1])] if runs else [],
        views=[*_views(out, runs), *([_compared(found)] if found else []), _cost(steps), *_proof(out)],
        warnings=_warnings(steps, out, runs),
        configurations=Configuration.of_files(out / RESULT, _FILES),
    )
    tables = [table, *([found.table()] if found else [])]
    robot = [("robot", Path(asked.robot).stem if asked.robot else "a person drove it"), ("seed", str(asked.seed))]
    return Page("diffdrive-mpc commission", "Commissioning", shown, tables, origin(describe_run(seconds), robot))


def _sentence(steps: Mapping[str, Done], whole: bool) -> str:
    if whole:
        return f"All {len(steps)} steps passed: model, configuration, twin and proof are in the folder “{RESULT}”."
    stopped = [name for name, one in steps.items() if not one.passed]
    return (
        f"It stopped at the step “{stopped[0]}”." if stopped else f"{len(steps)} steps are done, all of which passed."
    )


def _key_figures(
    steps: Mapping[str, Done], runs: Mapping[str, Run], found: Comparison | None, whole: bool
) -> list[KeyFigure]:
    passed, cost = sum(one.passed for one in steps.values()), sum(one.processor_s for one in steps.values())
    made = [
        KeyFigure("steps passed", f"{passed} of {len(steps)}", "each gates the next", "good" if whole else "bad"),
        KeyFigure("processor time", f"{cost:.0f} s", "of all steps"),
    ]
    for path, run in runs.items():
        rmse = f"{1e3 * run.metrics.position_rmse_m:.1f} mm"
        made.append(KeyFigure(f"position error on the twin, {path}", rmse, "RMSE, with the delivered configuration"))
    if found is not None:
        side = "below" if found.below_shipped >= 0 else "above"
        less = f"{100 * abs(found.below_shipped):.0f} % {side} the shipped one"
        made.append(KeyFigure("error over that with true parameters", f"{found.over_informed:.2f}", less))
    return made


def _on_the_twin(asked: Asked, out: Path) -> dict[str, Run]:
    """The delivered controller along some paths on the twin, by path."""
    place = out / RESULT
    config = str(place / CONFIG_FILE)
    plant = f"mujoco:{place / TWIN_FILE}"
    model = load_config(config).model
    return {
        path: run_case(Case(model=model, config=config, plant=plant, trajectory=path, scaled=asked.scaled))
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
    return [Runs(series, note)]


def _compared(found: Comparison) -> Chart:
    series = [
        Series(name, PATHS, [round(1e3 * found.errors[name][path], 2) for path in PATHS], i, "bars")
        for i, name in enumerate((SHIPPED, COMMISSIONED, INFORMED))
    ]
    return Chart("On the robot itself", Axis("path", "category"), Axis("position RMSE [mm]"), series)


def _cost(steps: Mapping[str, Done]) -> Chart:
    names, cost = list(steps), [round(one.processor_s, 1) for one in steps.values()]
    axes = Axis("step", "category"), Axis("processor time [s]")
    return Chart("What each step cost", *axes, [Series("processor time", names, cost, 0, "bars")])


def _proof(out: Path) -> list[View]:
    found = sorted((out / "prove" / "figures").glob("*.png"))
    return [Picture(f"Proof: {path.stem.replace('-', ' ')}", picture(path), broad=False) for path in found]


def _warnings(steps: Mapping[str, Done], out: Path, runs: Mapping[str, Run]) -> list[Warned]:
    found = [
        Warned(f"{name}: {one.sentence}.", f"what the step printed is in {name}/said.txt; mend it and call again")
        for name, one in steps.items()
        if not one.passed
    ]
    config = load_config(out / RESULT / CONFIG_FILE) if runs else None
    return found + [one for path, run in runs.items() for one in run_warnings(run, config, f"{path} on the twin")]
