"""Base class of all studies. A study presents its runs as tables, figures, NAME.md, NAME.json and a page.

docs/recipes.md shows how to add a study.
"""

from __future__ import annotations

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import other_robots, reference_remarks
from diffdrive_mpc.bench.html_report.document import picture, write_page
from diffdrive_mpc.bench.html_report.origin import origin
from diffdrive_mpc.bench.html_report.page import NO_CONTENTS, Chart, EmbeddedPicture, GridMap, Page, PageContents
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.report_folder import REPORT, page_in, staged
from diffdrive_mpc.bench.runner import OnDone, available_cores, run_tasks
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.suggestions import format_unknown_name

P = TypeVar("P")
R = TypeVar("R")
Draw = Callable[[Path], None]
Charts = Sequence[Chart | GridMap]
Meta = Mapping[str, Any]
FIGURES = "figures"
_MAX_SEQUENTIAL_FIGURES = 8
"""Maximum number of figures that are drawn in this process; other processes must first load matplotlib."""


@dataclass(frozen=True)
class Report:
    """Report of a study.

    Attributes
    ----------
    size
        Number of runs as text, such as "12 runs".
    meta
        Entries of `meta` in addition to computer, versions and duration: definitions and requested settings.
    content
        Content of the JSON file in addition to `meta`: lists of rows by name.
    facts, notes
        Sentences of the introduction before and after the description of the computer.
    tables
        Tables in their order.
    figures
        Figures by file name: charts, which are drawn side by side in the file and also shown on the page, or a function
        that draws any other figure.
    figures_first
        Number of figures above the tables; all other figures are below the tables. None for all figures.
    shown
        Content of the page `report.html` in addition to tables and figures.
    files
        Texts of further files by file name.
    screen
        Tables that the terminal shows instead of `tables`; empty for `tables`.
    """

    size: str
    meta: dict[str, object]
    content: dict[str, object]
    facts: Sequence[str]
    tables: Sequence[Table]
    figures: Mapping[str, Charts | Draw] = field(default_factory=dict)
    notes: Sequence[str] = ()
    figures_first: int | None = None
    shown: PageContents = NO_CONTENTS
    files: Mapping[str, str] = field(default_factory=dict)
    screen: Sequence[Table] = ()

    @property
    def drawings(self) -> dict[str, Draw]:
        """Return functions that draw the figures, by file name."""
        return {
            name: figure if callable(figure) else partial(_draw_charts, figure) for name, figure in self.figures.items()
        }

    @property
    def charts(self) -> list[Chart | GridMap]:
        """All charts in their order."""
        return [chart for figure in self.figures.values() if not callable(figure) for chart in figure]


class Study(ABC, Generic[P, R]):
    """Base class of a study; subclasses define the runs and their presentation, and `carry_out` runs the study.

    P is the type of the plan, R that of the results. `name` is the name of the command and of the files; `title` is the
    heading of the report.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    shared: ClassVar[bool] = False
    """True if several processes may run the study in the same folder at the same time."""

    @abstractmethod
    def plan(self) -> P:
        """Plan the runs before any folder is created.

        Raise ConfigError or ValueError if a named item does not exist or cannot be used.
        """

    def cases(self, plan: P) -> Iterable[Case]:  # noqa: ARG002
        """List the cases for which a note reports that plant and configuration describe different robots."""
        return ()

    def reference_cases(self, plan: P) -> Iterable[Case]:  # noqa: ARG002
        """List the cases for which notes report the differences between the references and their files."""
        return ()

    @abstractmethod
    def run(self, plan: P, jobs: int, bar: ProgressBar) -> R:
        """Execute the plan in `jobs` processes."""

    @abstractmethod
    def report(self, results: R, seconds: float) -> Report:
        """Build the report of `results`; the runs took `seconds`. Import matplotlib only inside this method."""


def carry_out(study: Study[P, R], out: Path, jobs: int | None = None) -> R:
    """Run a study, print its tables and write its report to `out`.

    Parameters
    ----------
    study
        The study.
    out
        Folder of the report.
    jobs
        Number of processes; by default the number of cores.

    Raise ConfigError, ValueError or OSError if a named item or `out` cannot be used; `out` is then unchanged. Raise
    StudyFailedError if the study could not be completed.
    """
    start = time.perf_counter()
    plan = study.plan()
    files = (REPORT, f"{study.name}.json", f"{study.name}.md")
    with (
        staged(out, files, (FIGURES,), owner=study.name, shared=study.shared) as folder,
        ProgressBar("preparing", lines=True) as bar,
    ):
        for sentence in (*other_robots(study.cases(plan)), *reference_remarks(study.reference_cases(plan))):
            output_console().print(f"note: {sentence}", markup=False, highlight=False, soft_wrap=True)
        results = study.run(plan, jobs or available_cores(), bar)
        run = describe_run(time.perf_counter() - start)
        report = study.report(results, run["wall_time_s"])
        bar.start_stage("drawing figures", len(report.drawings))
        write_report(study, report, run | report.meta, folder, bar.advance, jobs or available_cores())
    print_report(report, run["wall_time_s"], page_in(out, study.name))
    return results


def print_report(report: Report, seconds: float, page: Path) -> None:
    """Print the warnings, the tables and the path of a report; `seconds` is the duration of the runs."""
    console = output_console()
    for warning in report.shown.warnings:
        remedy = f" What to do: {warning.remedy}" if warning.remedy else ""
        console.print(f"warning: {warning.text}{remedy}", highlight=False)
    for table in report.screen or report.tables:
        console.print(table.rich())
    console.print(f"{report.size} in {seconds:g} s; report: {page}", highlight=False, soft_wrap=True)


def write_report(
    study: Study[P, R], report: Report, meta: Meta, folder: Path, on_figure: OnDone = lambda: None, jobs: int = 1
) -> None:
    """Write `NAME.json`, the figures, further files, `NAME.md` and the page to the existing `folder`.

    `on_figure` is called after each figure. If there are many figures, `jobs` processes draw them.
    """
    (folder / f"{study.name}.json").write_text(json_text(meta, report.content), encoding="utf-8")
    for name, text in report.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    if report.drawings:
        (folder / FIGURES).mkdir()
    draws = [partial(draw, folder / FIGURES / name) for name, draw in report.drawings.items()]
    run_tasks(draws, jobs if len(draws) > _MAX_SEQUENTIAL_FIGURES else 1, on_figure)
    (folder / f"{study.name}.md").write_text(markdown(study.title, report, meta), encoding="utf-8")
    write_page(report_page(study, report, meta, folder / FIGURES), folder / REPORT)


def report_page(study: Study[P, R], report: Report, meta: Meta, figures: Path) -> Page:
    """Build the page of the report with its views, its charts and, if requested, the pictures in `figures`."""
    names = [name for name, figure in report.figures.items() if callable(figure) and report.shown.pictures]
    pictures = [EmbeddedPicture(_title(name), picture(figures / name)) for name in names]
    summary, notes = (*report.shown.summary, *report.facts), (*report.shown.notes, *report.notes)
    views = (*report.shown.views, *report.charts, *pictures)
    shown = replace(report.shown, summary=summary, notes=notes, views=views)
    return Page(f"diffdrive-mpc {study.name}", study.title, shown, report.tables, origin(meta))


def json_text(meta: Meta, content: Mapping[str, object]) -> str:
    """Format `{"meta": ..., NAME: ...}` with one row of a list per line; numbers that are not finite become null."""
    parts = {"meta": json.dumps(plain(meta), indent=1, allow_nan=False)}
    for name, value in plain(content).items():
        if isinstance(value, list):
            parts[name] = "[\n" + ",\n".join(json.dumps(row, allow_nan=False) for row in value) + "\n]"
        else:
            parts[name] = json.dumps(value, indent=1, allow_nan=False)
    return "{" + ",\n".join(f'"{name}": {text}' for name, text in parts.items()) + "}\n"


def markdown(title: str, report: Report, meta: Meta) -> str:
    """Format the report as Markdown: description of runs and computer, tables, and links to the figures."""
    images = [f"![{Path(name).stem}]({FIGURES}/{name})" for name in report.drawings]
    upper = len(images[: report.figures_first])
    parts = [f"# {title}", "", *(f"* {line}" for line in (*report.facts, *run_facts(meta), *report.notes)), ""]
    parts += [f"{image}\n" for image in images[:upper]]
    parts += [table.markdown() for table in report.tables]
    parts += ["## Figures", "", *images[upper:]] if images[upper:] else []
    return "\n".join(parts).rstrip() + "\n"


def run_facts(meta: Meta) -> list[str]:
    """Return two sentences about a run: version, revision and date; computer and packages."""
    machine = meta["machine"]
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    revision = f", revision {meta['revision']}" if meta["revision"] else ""
    return [
        f"diffdrive-mpc {meta['version']}{revision}, {meta['date']}.",
        f"{machine['cpu']}, {machine['cores']} cores, {machine['os']}, Python {machine['python']}, {packages}.",
    ]


def _draw_charts(charts: Charts, path: Path) -> None:
    from diffdrive_mpc.bench.chart_drawing import draw_charts  # noqa: PLC0415 - matplotlib loads slowly

    draw_charts(charts, path)


def _title(figure: str) -> str:
    title = Path(figure).stem.replace("-", " ")
    return title[:1].upper() + title[1:]


def check_parts(only: Sequence[str], parts: Sequence[str]) -> None:
    """Raise ConfigError if `only` contains an unknown part of a study."""
    unknown = [name for name in only if name not in parts]
    if unknown:
        raise ConfigError(f"--only: unknown part {format_unknown_name(unknown[0], parts)}")
