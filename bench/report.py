"""Write `bench.json`, `bench.md` and the figures."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from diffdrive_mpc.bench.case import NO_SCENARIO
from diffdrive_mpc.bench.figures.draw import draw_all
from diffdrive_mpc.bench.results import Results, chosen_configuration
from diffdrive_mpc.bench.tables import report_tables

REPORT_FILES = ("bench.json", "bench.md")
FIGURES = "figures"


def write_report(results: Results, folder: Path, on_done: Callable[[], None] = lambda: None) -> None:
    """Write the report of `results` into `folder`, which exists; `on_done` is called after each figure."""
    (folder / "bench.json").write_text(
        json.dumps(results.as_json(), indent=1, allow_nan=False) + "\n", encoding="utf-8"
    )
    figures = folder / FIGURES
    figures.mkdir()
    names = draw_all(results, figures, on_done)
    (folder / "bench.md").write_text(markdown(results, names), encoding="utf-8")


def markdown(results: Results, figures: list[str]) -> str:
    """The report as Markdown: what was run on what, the tables, and the figures by their relative paths."""
    parts = ["# Bench", "", _introduction(results), ""]
    if figures:
        parts += [f"![overview](figures/{figures[0]})", ""]
    parts += [table.markdown() for table in report_tables(results)]
    if len(figures) > 1:
        parts += ["## Figures", ""]
        parts += [f"![{Path(name).stem}](figures/{name})" for name in figures[1:]]
    return "\n".join(parts).rstrip() + "\n"


def _introduction(results: Results) -> str:
    meta = results.meta
    machine, asked = meta["machine"], meta["experiment"]
    assert isinstance(machine, dict)
    assert isinstance(asked, dict)
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    revision = f", revision {meta['revision']}" if meta["revision"] else ""
    runs = len(results.all)
    disturbed = asked["scenarios"] != [NO_SCENARIO]
    scenarios = f"scenarios {', '.join(asked['scenarios'])}, " if disturbed else ""
    chosen = chosen_configuration(results.experiment)
    return "\n".join(
        [
            f"* {runs} runs in {meta['wall_time_s']} s; plant {', '.join(asked['plants'])}, "
            f"surface {', '.join(asked['surfaces'])}, sensors {', '.join(asked['sensors'])}, "
            f"{scenarios}seeds {', '.join(map(str, asked['seeds']))}.",
            *([f"* Configuration: {chosen}."] if chosen else []),
            f"* diffdrive-mpc {meta['version']}{revision}, {meta['date']}.",
            f"* {machine['cpu']}, {machine['cores']} cores, {machine['os']}, Python {machine['python']}, {packages}.",
            f"* Errors: {meta['statistics']}.",
            f"* Step times: {meta['step_times']}; the process had the core for "
            f"{100 * float(str(meta['step_times_cpu_share'])):.0f} % of that time.",
        ]
    )
