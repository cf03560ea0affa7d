"""Write `reproduce.json`, `reproduce.md` and the figures."""

from __future__ import annotations

import json
from pathlib import Path

from diffdrive_mpc.bench.figures.reproduce.odometry import draw_odometry
from diffdrive_mpc.bench.figures.reproduce.orders import draw_orders
from diffdrive_mpc.bench.figures.reproduce.virtual_track import draw_virtual_track
from diffdrive_mpc.bench.reproduce.findings import find
from diffdrive_mpc.bench.reproduce.results import Reproduction, plain
from diffdrive_mpc.bench.reproduce.tables import report_tables

REPORT_FILES = ("reproduce.json", "reproduce.md")
FIGURES = "figures"


def write_report(results: Reproduction, folder: Path) -> None:
    """Write the report of `results` into `folder`, which exists."""
    findings = [{**plain(finding), "verdict": finding.verdict} for finding in find(results)]
    data = {"findings": findings, **plain(results)}
    (folder / "reproduce.json").write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    (folder / FIGURES).mkdir()
    names = draw_all(results, folder / FIGURES)
    (folder / "reproduce.md").write_text(markdown(results, names), encoding="utf-8")


def draw_all(results: Reproduction, folder: Path) -> list[str]:
    """Draw the figures of the parts that were run into `folder`, which exists; returns their names."""
    names = []
    if results.mbm_sm:
        draw_odometry(results.mbm_sm, folder / "odometry.png")
        names.append("odometry.png")
    if results.ssm:
        draw_orders(results.ssm, folder / "orders.png")
        names.append("orders.png")
    if results.virtual_track is not None:
        draw_virtual_track(results.virtual_track, folder / "virtual-track.png")
        names.append("virtual-track.png")
    return names


def markdown(results: Reproduction, figures: list[str]) -> str:
    """The report as Markdown: what was run on what, the figures, and the tables."""
    parts = ["# The papers repeated", "", introduction(results), ""]
    parts += [f"![{Path(name).stem}]({FIGURES}/{name})\n" for name in figures]
    parts += [table.markdown() for table in report_tables(results)]
    return "\n".join(parts).rstrip() + "\n"


def introduction(results: Reproduction) -> str:
    """What was run on what, as a list."""
    meta = results.meta
    machine = meta["machine"]
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    revision = f", revision {meta['revision']}" if meta["revision"] else ""
    repetitions = ", ".join(map(str, results.study.repetitions))
    return "\n".join(
        [
            f"* Parts {', '.join(meta['parts'])} in {meta['wall_time_s']} s; plant mujoco, surface default, sensors "
            f"default, repetitions {repetitions}.",
            f"* diffdrive-mpc {meta['version']}{revision}, {meta['date']}.",
            f"* {machine['cpu']}, {machine['cores']} cores, {machine['os']}, Python {machine['python']}, {packages}.",
        ]
    )
