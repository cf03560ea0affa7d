"""A commissioning at the command line: a sentence for each step, the table in the end, the comparison where asked."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

from diffdrive_mpc.app.commission.commissioning import RESULT, Asked, commission
from diffdrive_mpc.app.commission.comparison import COMMISSIONED, INFORMED, SHIPPED, Comparison, compare
from diffdrive_mpc.app.commission.drawn_robot import write_drawn_robot
from diffdrive_mpc.app.commission.ledger import Done
from diffdrive_mpc.app.commission.page import commission_page
from diffdrive_mpc.bench.contents import REPORT
from diffdrive_mpc.bench.html_report.document import write_page
from diffdrive_mpc.bench.progress import output_console
from diffdrive_mpc.models.identification.configuration import CONFIG_FILE
from diffdrive_mpc.models.whole_file import whole_file

ROBOT_FILE, COMPARISON = "robot.yaml", "comparison.json"


def commission_into(asked: Asked, out: Path, *, one: bool = False, drawn: int | None = None) -> bool:
    """Commission, print what each step found, and compare where the robot is a drawn one.

    Returns whether all steps passed; raises as `commissioning.commission` and `comparison.compare`.
    """
    if drawn is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_drawn_robot(drawn, out / ROBOT_FILE)
        asked = replace(asked, robot=str(out / ROBOT_FILE))
    began, steps = time.perf_counter(), dict[str, Done]()

    def done(name: str, step: Done, new: bool) -> None:
        steps[name] = step
        _say(name, step, new)

    passed = commission(asked, out, one=one, on_step=done)
    found = None
    if passed and (out / RESULT).is_dir():
        _print(f"{out / RESULT}: model, configuration, twin, proof and report.")
        found = None if drawn is None else _compared(asked, out, drawn)
    with whole_file(out / REPORT) as draft:
        write_page(commission_page(asked, out, steps, found, time.perf_counter() - began), draft)
    return passed


def _compared(asked: Asked, out: Path, drawn: int) -> Comparison:
    """Compare what was commissioned on the robot that was drawn, print it and keep it."""
    found = compare(out / ROBOT_FILE, out / RESULT / CONFIG_FILE, asked.config, out / "compare", asked.jobs)
    _write(found, drawn, out / COMPARISON)
    output_console().print(found.table().rich())
    _print(_sentence(found))
    return found


def _sentence(found: Comparison) -> str:
    less = 100 * found.below_shipped
    return (
        f"On the robot itself: {found.over_informed:.2f} times the error of a controller with the true parameters, "
        f"{abs(less):.0f} % {'below' if less >= 0 else 'above'} the shipped configuration's."
    )


def _write(found: Comparison, seed: int, path: Path) -> None:
    content = {
        "seed": seed,
        "position_rmse_m": {name: dict(found.errors[name]) for name in (SHIPPED, COMMISSIONED, INFORMED)},
        "over_true_parameters": found.over_informed,
        "below_shipped": found.below_shipped,
    }
    with whole_file(path) as draft:
        draft.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _say(name: str, done: Done, new: bool) -> None:
    cost = f"{done.processor_s:.0f} s of processor time" if new else "done before"
    mark = "" if done.passed else "STOP: "
    _print(f"{name}: {mark}{done.sentence} ({cost}).")


def _print(line: str) -> None:
    output_console().print(line, markup=False, highlight=False, soft_wrap=True)
