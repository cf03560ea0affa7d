"""Whether the reports that the documents show were made by a controller that sends today's commands.

`docs/twelve-drives.json` holds the commands of twelve drives as sums, and names the reports that were made with them.
Reports that are older say so in their own text.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable
from pathlib import Path

import numpy as np

from diffdrive_mpc import simulate

RECORD = Path("docs/twelve-drives.json")
MODELS = ("mbm", "sm", "ssm")
TRAJECTORIES = ("circle", "square", "s", "cane")
OLDER = "* Older than the last change of the controller's commands: `make results` makes it anew."
TOLERANCE = 1e-6
"""Relative: processors round differently."""


def drives() -> dict[str, list[float]]:
    """Drive the simulated robot; ticks and sums of |v| [m/s], |omega| [rad/s] and both times the tick, by drive."""
    sums = {}
    for model in MODELS:
        for trajectory in TRAJECTORIES:
            commands = np.asarray(simulate(model, "mujoco", trajectory).command)
            ticks = np.arange(1, len(commands) + 1)
            sums[f"{model} {trajectory}"] = [len(commands), *np.abs(commands).sum(axis=0), *ticks @ commands]
    return {name: [float(number) for number in row] for name, row in sums.items()}


def alike(first: dict[str, list[float]], second: dict[str, list[float]]) -> bool:
    """Whether two sets of drives have the same commands but for rounding."""
    return first.keys() == second.keys() and all(
        np.allclose(first[name], second[name], rtol=TOLERANCE, atol=0.0) for name in first
    )


def record(documents: Path, made: Collection[str], names: Iterable[str]) -> None:
    """Note that the reports `made` are of today's commands.

    Where those differ from the commands of the record, all other reports of `names` are older, and get a line that
    says so.
    """
    path = documents / RECORD.name
    now = drives()
    known = json.loads(path.read_text(encoding="utf-8"))
    kept = set(known["reports"]) if alike(known["drives"], now) else set()
    current = sorted(kept | set(made))
    for name in set(names) - set(current):
        mark_as_older(documents / name / f"{name}.md")
    path.write_text(json.dumps({"reports": current, "drives": now}, indent=1) + "\n", encoding="utf-8")


def mark_as_older(report: Path) -> None:
    """Add the line to the facts of a report, unless it is there."""
    text = report.read_text(encoding="utf-8")
    if OLDER not in text:
        title, _, rest = text.partition("\n\n")
        report.write_text(f"{title}\n\n{OLDER}\n{rest}", encoding="utf-8")
