"""Copy tables and figures of a bench run and of studies into the documents, so that they show what was produced.

Run as ``python -m diffdrive_mpc.bench.documents OUT [STUDY_OUT ...]``, from the top of the repository.
"""

from __future__ import annotations

import re
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError

COPIED = ("bench.md", "bench.json", "figures/overview.png", "figures/horizon.png")
"""What the documents show of a report."""
_NOT_RUN = "This part was not run."


@dataclass(frozen=True)
class Study:
    """A report `NAME.md` with figures, which `make NAME` writes and a page shows, by default docs/NAME.md.

    `records` are files that are committed beside it.
    """

    name: str
    figures: tuple[str, ...]
    records: tuple[str, ...] = ()
    shown_in: str = ""

    @property
    def page(self) -> str:
        """File name of the page."""
        return self.shown_in or f"{self.name}.md"


TRACKING = Study("tracking", ("ablation.png", "error-sources.png"))
REPRODUCE = Study("reproduce", ("odometry.png", "orders.png", "virtual-track.png"))
SPEED = Study("speed", ("horizon.png", "tail.png"), ("speed.json",), "performance.md")
STUDIES = (TRACKING, REPRODUCE, SPEED)


def copy_report(out: Path, documents: Path) -> None:
    """Copy the report in `out` to `documents`, links to figures that are not copied left out.

    Raises
    ------
    models.checked_yaml.ConfigError
        If `out` holds no report.
    """
    if not (out / "bench.md").is_file():
        raise ConfigError(f"{out}: no bench.md; run `make bench` first")
    documents.mkdir(parents=True, exist_ok=True)
    for name in COPIED:
        shutil.copyfile(out / name, documents / Path(name).name)
    report = documents / "bench.md"
    known = {Path(name).name for name in COPIED}
    lines = report.read_text(encoding="utf-8").replace("](figures/", "](").splitlines()
    kept = [line for line in lines if not line.startswith("![") or line.split("](")[1].rstrip(")") in known]
    report.write_text("\n".join(kept) + "\n", encoding="utf-8")


def summary(report: str) -> str:
    """The facts and the summary table of a `bench.md`, as they stand in the README."""
    facts = [line for line in report.splitlines() if line.startswith("* ")]
    table = report.split("## Summary\n", 1)[1].split("\n## ", 1)[0].strip()
    return "\n".join([table, "", *facts])


def insert(document: str, text: str, name: str = "bench") -> str:
    """`document` with `text` between the markers of that name."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    before, rest = document.split(begin, 1)
    return f"{before}{begin}\n{text}\n{end}{rest.split(end, 1)[1]}"


def copy_study(study: Study, out: Path, documents: Path) -> None:
    """Copy the report of a study in `out` and its figures to `documents`; figures of an earlier one go.

    Raises
    ------
    models.checked_yaml.ConfigError
        If `out` holds no report.
    """
    name = f"{study.name}.md"
    if not (out / name).is_file():
        raise ConfigError(f"{out}: no {name}; run `make {study.name}` first")
    documents.mkdir(parents=True, exist_ok=True)
    report = (out / name).read_text(encoding="utf-8")
    for figure in study.figures:
        (documents / figure).unlink(missing_ok=True)
        if f"](figures/{figure})" in report:
            shutil.copyfile(out / "figures" / figure, documents / figure)
    for record in study.records:
        shutil.copyfile(out / record, documents / record)
    (documents / name).write_text(report.replace("](figures/", "]("), encoding="utf-8")


def study_sections(study: Study, report: str) -> dict[str, str]:
    """The facts, figures and tables of a study's report by the names of their markers."""
    head, *sections = report.split("\n## ")
    lines = head.splitlines()
    parts = {f"{study.name}-runs": "\n".join(line for line in lines if line.startswith("* "))}
    for line in lines:
        if line.startswith("!["):
            name = line[2:].partition("]")[0]
            parts[f"{study.name}-figure-{name}"] = line.replace("](", f"]({study.name}/")
    for section in sections:
        title, _, body = section.partition("\n")
        parts[f"{study.name}-{title.lower().replace(' ', '-')}"] = body.strip()
    return parts


def with_study(study: Study, document: str, report: str) -> str:
    """`document` with every part of the report between its markers; parts that were not run say so."""
    parts = study_sections(study, report)
    for name in re.findall(rf"<!-- ({study.name}-[a-z-]+):begin -->", document):
        document = insert(document, parts.get(name, _NOT_RUN), name)
    return document


def main(out: Path, *studies: Path) -> None:
    """Update docs/bench and the README, and the pages of those studies whose reports are given.

    Everything is below the current folder.
    """
    copy_report(out, Path("docs/bench"))
    readme = Path("README.md")
    text = summary(Path("docs/bench/bench.md").read_text(encoding="utf-8"))
    readme.write_text(insert(readme.read_text(encoding="utf-8"), text), encoding="utf-8")
    for folder in studies:
        update_study(folder)


def update_study(out: Path) -> None:
    """Update docs/NAME and docs/NAME.md with the report in `out`; raises ConfigError if there is none."""
    study = next((study for study in STUDIES if (out / f"{study.name}.md").is_file()), None)
    if study is None:
        raise ConfigError(f"{out}: no report of {', '.join(study.name for study in STUDIES)}")
    copy_study(study, out, Path("docs") / study.name)
    report = (Path("docs") / study.name / f"{study.name}.md").read_text(encoding="utf-8")
    page = Path("docs") / study.page
    page.write_text(with_study(study, page.read_text(encoding="utf-8"), report), encoding="utf-8")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
