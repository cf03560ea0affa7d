"""Write `tracking.json`, `tracking.md` and the figures."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from diffdrive_mpc.bench.figures.ablation import draw_ablation
from diffdrive_mpc.bench.figures.error_sources import draw_error_sources
from diffdrive_mpc.bench.tracking.results import StudyResults
from diffdrive_mpc.bench.tracking.tables import study_tables

REPORT_FILES = ("tracking.json", "tracking.md")
FIGURES = "figures"
_DRAWINGS: dict[str, Callable[[StudyResults, Path], None]] = {
    "ablation.png": draw_ablation,
    "error-sources.png": draw_error_sources,
}


def write_report(results: StudyResults, folder: Path) -> None:
    """Write the report of `results` into `folder`, which exists; figures only where there was an ablation."""
    runs = ",\n".join(json.dumps(run, allow_nan=False) for run in results.as_json()["runs"])  # type: ignore[attr-defined]
    meta = json.dumps(results.meta, indent=1, allow_nan=False)
    (folder / "tracking.json").write_text(f'{{"meta": {meta},\n"runs": [\n{runs}\n]}}\n', encoding="utf-8")
    names = draw_all(results, folder / FIGURES) if "ablation" in results.parts else []
    (folder / "tracking.md").write_text(markdown(results, names), encoding="utf-8")


def draw_all(results: StudyResults, folder: Path) -> list[str]:
    """Draw the figures of a study with an ablation into `folder`, which is made; returns their names."""
    folder.mkdir()
    for name, draw in _DRAWINGS.items():
        draw(results, folder / name)
    return list(_DRAWINGS)


def markdown(results: StudyResults, figures: list[str]) -> str:
    """The report as Markdown: what was run on what, the figures, and the tables part by part."""
    parts = ["# Tracking", "", introduction(results), ""]
    parts += [f"![{Path(name).stem}]({FIGURES}/{name})\n" for name in figures]
    parts += [table.markdown() for tables in study_tables(results).values() for table in tables]
    return "\n".join(parts).rstrip() + "\n"


def introduction(results: StudyResults) -> str:
    """What was run on what, as a list."""
    meta = results.meta
    machine = meta["machine"]
    assert isinstance(machine, dict)
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    revision = f", revision {meta['revision']}" if meta["revision"] else ""
    seeds = results.study.targets.seeds
    return "\n".join(
        [
            f"* {len(results.all)} runs in {meta['wall_time_s']} s; targets over seeds {', '.join(map(str, seeds))}.",
            f"* diffdrive-mpc {meta['version']}{revision}, {meta['date']}.",
            f"* {machine['cpu']}, {machine['cores']} cores, {machine['os']}, Python {machine['python']}, {packages}.",
            f"* Errors: {meta['statistics']}.",
        ]
    )
