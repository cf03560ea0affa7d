"""A commissioning at the command line: a sentence for each step, the table in the end, the comparison where asked."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from diffdrive_mpc.app.commission.commissioning import RESULT, CommissionRequest, commission
from diffdrive_mpc.app.commission.ledger import Done
from diffdrive_mpc.app.commission.page import (
    COMMISSIONED,
    INFORMED,
    SHIPPED,
    ControllerComparison,
    commission_page,
    compare,
)
from diffdrive_mpc.bench.html_report.document import write_page
from diffdrive_mpc.bench.progress import output_console
from diffdrive_mpc.bench.report_folder import REPORT
from diffdrive_mpc.models.checked_yaml import read_yaml
from diffdrive_mpc.models.identification.deliver.configuration import CONFIG_FILE
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc_extras.campaign.draws import Draw, read_factor

# A robot of the physics that nobody knows, drawn from a seed.


_FILE = Path(__file__).with_name("drawn_robots.yaml")
_SKID = "skid_share"


def drawn_robot(seed: int) -> dict[str, Any]:
    """A robot file as plain data; one of a seed is always the same."""
    draws = _draws()
    points = np.random.default_rng(seed).uniform(size=len(draws))
    drawn = {
        name: float(f"{draw.value(point, 0):.4g}") for (name, draw), point in zip(draws.items(), points, strict=True)
    }
    drawn["firmware.track"] = float(f"{drawn.pop(_SKID) * drawn['robot.track']:.4g}")
    content: dict[str, Any] = {"description": f"drawn robot, seed {seed}"}
    for name, value in drawn.items():
        *groups, key = name.split(".")
        place = content
        for group in groups:
            place = place.setdefault(group, {})
        place[key] = value
    return content


def write_drawn_robot(seed: int, path: Path) -> None:
    """Write the robot file; raises ConfigError if it cannot be written."""
    with whole_file(path) as draft:
        draft.write_text(yaml.safe_dump(drawn_robot(seed), sort_keys=False), encoding="utf-8")


@cache
def _draws() -> dict[str, Draw]:
    data = read_yaml(_FILE)
    read = {str(name): read_factor(draw, f"{_FILE.name}: {name}") for name, draw in dict(data).items()}
    return {name: draw for name, draw in read.items() if isinstance(draw, Draw)}


ROBOT_FILE, COMPARISON = "robot.yaml", "comparison.json"


def commission_into(request: CommissionRequest, out: Path, *, one_step: bool = False, drawn: int | None = None) -> bool:
    """Commission, print what each step found, and compare where the robot is a drawn one.

    Returns whether all steps passed; raises as `commissioning.commission` and `comparison.compare`.
    """
    if drawn is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_drawn_robot(drawn, out / ROBOT_FILE)
        request = replace(request, robot=str(out / ROBOT_FILE))
    began, steps = time.perf_counter(), dict[str, Done]()

    def done(name: str, step: Done, new: bool) -> None:
        steps[name] = step
        _say(name, step, new)

    passed = commission(request, out, one_step=one_step, on_step=done)
    comparison = None
    if passed and (out / RESULT).is_dir():
        _print(f"{out / RESULT}: model, configuration, twin, proof and report.")
        comparison = None if drawn is None else _compared(request, out, drawn)
    with whole_file(out / REPORT) as draft:
        write_page(commission_page(request, out, steps, comparison, time.perf_counter() - began), draft)
    return passed


def _compared(request: CommissionRequest, out: Path, drawn: int) -> ControllerComparison:
    """Compare what was commissioned on the robot that was drawn, print it and keep it."""
    comparison = compare(out / ROBOT_FILE, out / RESULT / CONFIG_FILE, request.config, out / "compare", request.jobs)
    _write(comparison, drawn, out / COMPARISON)
    output_console().print(comparison.table().rich())
    _print(_sentence(comparison))
    return comparison


def _sentence(comparison: ControllerComparison) -> str:
    less = 100 * comparison.below_shipped
    return (
        f"On the robot itself: {comparison.over_informed:.2f} times the error of a controller with the true "
        f"parameters, {abs(less):.0f} % {'below' if less >= 0 else 'above'} the shipped configuration's."
    )


def _write(comparison: ControllerComparison, seed: int, path: Path) -> None:
    content = {
        "seed": seed,
        "position_rmse_m": {name: dict(comparison.errors[name]) for name in (SHIPPED, COMMISSIONED, INFORMED)},
        "over_true_parameters": comparison.over_informed,
        "below_shipped": comparison.below_shipped,
    }
    with whole_file(path) as draft:
        draft.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _say(name: str, done: Done, new: bool) -> None:
    cost = f"{done.processor_s:.0f} s of processor time" if new else "done before"
    mark = "" if done.passed else "STOP: "
    _print(f"{name}: {mark}{done.sentence} ({cost}).")


def _print(line: str) -> None:
    output_console().print(line, markup=False, highlight=False, soft_wrap=True)
