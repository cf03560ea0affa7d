"""Copy reports to the documents and insert their tables into pages.

Run `python -m studies.documents.documents OUT ...` in the root folder of the repository.

The command also marks outdated reports: `docs/twelve-drives.json` contains checksums of the commands of twelve drives,
and the names of the reports that correspond to these commands. All other reports contain the line `OLDER`.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from diffdrive_mpc import simulate
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.models.checked_yaml import ConfigError

_NOT_RUN = "This part was not run."
_TARGETS = {
    "bench": "bench-full",
    **{name: name for name in ("edge", "robustness", "market", "prove", "tune")},
}
"""Make targets by name of the report; the target `study` writes all other reports."""


@dataclass(frozen=True)
class DocumentedReport:
    """Parts of the report `NAME.md` that the documents contain.

    Attributes
    ----------
    name
        Name of the study.
    figures, records
        Names of the figures and of the data files that are copied to the documents.
    page
        Path, relative to `docs`, of the document that contains the tables between markers; empty if documents only link
        to the report.
    brief
        True if this document also contains the first table and the facts, between markers with the name of the study.
    study
        Name of the study if it writes several reports, so that `name` is the name of the folder; otherwise empty.
    """

    name: str
    figures: tuple[str, ...]
    records: tuple[str, ...]
    page: str = ""
    brief: bool = False
    study: str = ""

    @property
    def target(self) -> str:
        """Make target that writes the report."""
        return _TARGETS.get(self.name, f"study NAME={self.name}")

    @property
    def file(self) -> str:
        """File name of the report."""
        return f"{self.study or self.name}.md"


BENCH = DocumentedReport(
    "bench",
    ("overview.png", "speed.png", "dead-time.png", "horizon.png"),
    ("bench.json",),
    "../README.md",
    brief=True,
)
TRACKING = DocumentedReport("tracking", ("ablation.png", "error-sources.png"), ())
REPRODUCE = DocumentedReport(
    "reproduce",
    ("odometry.png", "orders.png", "virtual-track.png"),
    (),
    "reproduce.md",
)
SPEED = DocumentedReport("speed", ("horizon.png", "tail.png"), ("speed.json",), "results.md")
PEERS = DocumentedReport("peers", (), ())
EDGE = DocumentedReport("edge", ("overview.png",), (), study="bench")
ROBUSTNESS = DocumentedReport("robustness", ("ratios.png",), ())
MARKET = DocumentedReport("market", (), (), study="robustness")
PROVE = DocumentedReport(
    "prove",
    ("errors.png", "map-dead-time-and-friction.png", "map-mass-and-latency.png"),
    (),
    "../packages/extras/docs/prove.md",
)
TUNE = DocumentedReport("tune", ("search.png",), (), "tuning.md")
PREDICTED_ERROR = DocumentedReport("predicted-error", (), (), "../packages/extras/docs/predicted-error.md")
REPORTS = (
    BENCH,
    TRACKING,
    REPRODUCE,
    SPEED,
    PEERS,
    EDGE,
    ROBUSTNESS,
    MARKET,
    PROVE,
    TUNE,
    PREDICTED_ERROR,
)


def copy_report(entry: DocumentedReport, out: Path, documents: Path) -> None:
    """Copy the report in `out` to `documents` with the figures of `entry`, and remove links to all other figures.

    Raise ConfigError if `out` does not contain the report.
    """
    if not (out / entry.file).is_file():
        raise ConfigError(f"{out}: no {entry.file}; run `make {entry.target}` first")
    documents.mkdir(parents=True, exist_ok=True)
    report = (out / entry.file).read_text(encoding="utf-8")
    for figure in entry.figures:
        (documents / figure).unlink(missing_ok=True)
        if f"](figures/{figure})" in report:
            shutil.copyfile(out / "figures" / figure, documents / figure)
    for record in entry.records:
        shutil.copyfile(out / record, documents / record)
    lines = report.replace("](figures/", "](").splitlines()
    selected_lines = [
        line for line in lines if not line.startswith("![") or line.split("](")[1].rstrip(")") in entry.figures
    ]
    (documents / f"{entry.name}.md").write_text("\n".join(selected_lines) + "\n", encoding="utf-8")


def sections(entry: DocumentedReport, report: str) -> dict[str, str]:
    """Split a report into facts, figures and tables, by name of the markers that enclose them in a document."""
    folder = os.path.relpath(f"docs/{entry.name}", Path("docs", entry.page).parent)
    head, *tables = report.split("\n## ")
    lines = head.splitlines()
    facts = "\n".join(line for line in lines if line.startswith("* "))
    parts = {f"{entry.name}-runs": facts}
    if entry.brief:
        first_table = tables[0].partition("\n")[2].strip()
        parts[entry.name] = f"{first_table}\n\n{facts}"
    for line in lines:
        if line.startswith("!["):
            name = line[2:].partition("]")[0]
            parts[f"{entry.name}-figure-{name}"] = line.replace("](", f"]({folder}/")
    for table in tables:
        title, _, body = table.partition("\n")
        parts[f"{entry.name}-{title.lower().replace(' ', '-')}"] = body.strip()
    return parts


def insert(document: str, text: str, name: str) -> str:
    """Replace the text between the markers `name` of `document` by `text`."""
    start, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    before, after = document.split(start, 1)
    return f"{before}{start}\n{text}\n{end}{after.split(end, 1)[1]}"


def format_machine() -> str:
    """Format revision, date and computer of this run, for a note below a table."""
    run = describe_run(0.0)
    machine = run["machine"]
    return f"revision {run['revision']}, {run['date']}, {machine['cores']} cores of {machine['cpu']}."


def with_report(entry: DocumentedReport, document: str, report: str) -> str:
    """Return `document` with the parts of a report between their markers; a note replaces missing parts."""
    parts = sections(entry, report)
    for name in re.findall(rf"<!-- ({entry.name}(?:-[a-z-]+)?):begin -->", document):
        document = insert(document, parts.get(name, _NOT_RUN), name)
    return document


def update(out: Path) -> str:
    """Update docs/NAME, and the document with its tables, from the report in `out`; return NAME.

    Raise ConfigError if `out` does not contain a report.
    """
    present = [candidate for candidate in REPORTS if (out / candidate.file).is_file()]
    if not present:
        raise ConfigError(f"{out}: contains no report of {', '.join(candidate.name for candidate in REPORTS)}")
    # Several reports may have the same file name; the name of the folder then decides.
    entry = next((candidate for candidate in present if candidate.name == out.name), present[0])
    folder = Path("docs") / entry.name
    copy_report(entry, out, folder)
    update_page(entry)
    return entry.name


def update_page(entry: DocumentedReport) -> None:
    """Insert the tables of docs/NAME into the document of the report, if it has a document."""
    if entry.page:
        report, page = Path("docs") / entry.name / f"{entry.name}.md", Path("docs") / entry.page
        text = with_report(entry, page.read_text(encoding="utf-8"), report.read_text(encoding="utf-8"))
        page.write_text(text, encoding="utf-8")


RECORD = Path("docs/twelve-drives.json")
DRIVE_MODELS = ("mbm", "sm", "ssm")
TRAJECTORIES = ("circle", "square", "s", "cane")
OLDER = "* Older than the last change of the controller's commands; `make results` updates it."
"""Line that marks reports which do not correspond to the current commands."""
TOLERANCE = 1e-6
"""Relative tolerance of the checksums [-]; rounding differs between processors."""


def drives() -> dict[str, list[float]]:
    """Drive the simulated robot and return checksums of the commands by name of the drive.

    The checksums are the number of ticks, the sums of |v| [m/s] and |omega| [rad/s], and the sums of v and omega
    weighted by the number of the tick, which also depend on the order of the commands.
    """
    sums = {}
    for model in DRIVE_MODELS:
        for trajectory in TRAJECTORIES:
            commands = np.asarray(simulate(model, "mujoco", trajectory).command)
            ticks = np.arange(1, len(commands) + 1)
            sums[f"{model} {trajectory}"] = [len(commands), *np.abs(commands).sum(axis=0), *ticks @ commands]
    return {name: [float(number) for number in row] for name, row in sums.items()}


def sums_agree(first: dict[str, list[float]], second: dict[str, list[float]]) -> bool:
    """Return True if the checksums of two sets of drives agree within `TOLERANCE`."""
    return first.keys() == second.keys() and all(
        np.allclose(first[name], second[name], rtol=TOLERANCE, atol=0.0) for name in first
    )


def record(documents: Path, updated: Collection[str], names: Iterable[str]) -> None:
    """Record that the reports `updated` correspond to the current commands, and mark outdated reports in `names`.

    If the commands differ from the recorded commands, all reports that are not in `updated` are outdated.
    """
    path = documents / RECORD.name
    current_sums = drives()
    recorded = json.loads(path.read_text(encoding="utf-8"))
    current_reports = set(recorded["reports"]) if sums_agree(recorded["drives"], current_sums) else set()
    current = sorted(current_reports | set(updated))
    for name in set(names) - set(current):
        mark_as_older(documents / name / f"{name}.md")
    path.write_text(json.dumps({"reports": current, "drives": current_sums}, indent=1) + "\n", encoding="utf-8")


def mark_as_older(report: Path) -> None:
    """Add the line `OLDER` to the facts of a report that does not contain it."""
    text = report.read_text(encoding="utf-8")
    if OLDER not in text:
        title, _, after = text.partition("\n\n")
        report.write_text(f"{title}\n\n{OLDER}\n{after}", encoding="utf-8")


if __name__ == "__main__":
    updated = [update(Path(argument)) for argument in sys.argv[1:]]
    record(Path("docs"), updated, [entry.name for entry in REPORTS])
    for entry in REPORTS:
        update_page(entry)
