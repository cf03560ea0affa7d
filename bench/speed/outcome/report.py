"""Write `speed.json`, `speed.md` and the figures."""

from __future__ import annotations

import json
import math
from pathlib import Path

from diffdrive_mpc.bench.figures.speed import draw_horizons, draw_tails
from diffdrive_mpc.bench.speed.outcome.results import SpeedResults
from diffdrive_mpc.bench.speed.outcome.tables import detailed_horizon, speed_tables

REPORT_FILES = ("speed.json", "speed.md")
FIGURES = "figures"
FIGURE_FILES = ("horizon.png", "tail.png")


def write_report(results: SpeedResults, folder: Path) -> None:
    """Write the report of `results` into `folder`, which exists."""
    lists = results.as_json()
    meta = json.dumps(lists.pop("meta"), indent=1, allow_nan=False)
    parts = [f'"{name}": [\n' + ",\n".join(map(_line, rows)) + "\n]" for name, rows in lists.items()]  # type: ignore[call-overload]
    text = ",\n".join([f'{{"meta": {meta}', *parts]) + "}\n"
    (folder / "speed.json").write_text(text, encoding="utf-8")
    figures = folder / FIGURES
    figures.mkdir()
    draw_horizons(results, figures / FIGURE_FILES[0])
    draw_tails(results, detailed_horizon(results), figures / FIGURE_FILES[1])
    (folder / "speed.md").write_text(markdown(results), encoding="utf-8")


def markdown(results: SpeedResults) -> str:
    """The report as Markdown: what was run on what, the figures, and the tables."""
    parts = ["# Speed", "", introduction(results), ""]
    parts += [f"![{Path(name).stem}]({FIGURES}/{name})\n" for name in FIGURE_FILES]
    parts += [table.markdown() for table in speed_tables(results)]
    return "\n".join(parts).rstrip() + "\n"


def introduction(results: SpeedResults) -> str:
    """What was run on what, as a list."""
    meta = results.meta
    machine, settings, load = meta["machine"], meta["settings"], meta["load"]
    assert isinstance(machine, dict)
    assert isinstance(settings, dict)
    assert isinstance(load, dict)
    peers = meta["peers"]
    assert isinstance(peers, list)
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    revision = f", revision {meta['revision']}" if meta["revision"] else ""
    core = "one core for all" if meta["core"] is not None else "no core of their own"
    return "\n".join(
        [
            f"* {settings['ticks']} ticks of {settings['trajectory']}, {settings['repetitions']} replays in blocks of "
            f"{settings['block']} ticks, {core}, one BLAS thread, in {meta['wall_time_s']} s; "
            f"{load['before']:.1f} processes ran on the machine before, {load['after']:.1f} after.",
            f"* diffdrive-mpc {meta['version']}{revision}, {meta['date']}.",
            f"* {machine['cpu']}, {machine['cores']} cores, {machine['os']}, Python {machine['python']}, {packages}.",
            f"* Peers: {', '.join(peers)}. Missing: {_missing(results)}.",
        ]
    )


def _missing(results: SpeedResults) -> str:
    reasons = {f"{one.solver} ({one.reason})": None for one in results.missing}
    return "; ".join(reasons) or "none"


def _line(row: dict[str, object]) -> str:
    finite = {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in row.items()}
    return json.dumps(finite, allow_nan=False)
