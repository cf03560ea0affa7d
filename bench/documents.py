"""Copy tables and figures of a bench run and a tracking study into the documents, so that they show what was produced.

Run as ``python -m bench.documents OUT [TRACKING_OUT]``, from the top of the repository.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

from models.checked_yaml import ConfigError

COPIED = ("bench.md", "bench.json", "figures/overview.png", "figures/horizon.png")
"""What the documents show of a report."""
TRACKING_FIGURES = ("ablation.png", "error-sources.png")
"""Figures of the tracking report."""
_SECTION = re.compile(r"<!-- (tracking-[a-z-]+):begin -->")
_NOT_RUN = "This part was not run."


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


def copy_tracking(out: Path, documents: Path) -> None:
    """Copy the tracking report in `out` and its figures to `documents`; figures of an earlier one go.

    Raises
    ------
    models.checked_yaml.ConfigError
        If `out` holds no report.
    """
    if not (out / "tracking.md").is_file():
        raise ConfigError(f"{out}: no tracking.md; run `make tracking` first")
    documents.mkdir(parents=True, exist_ok=True)
    report = (out / "tracking.md").read_text(encoding="utf-8")
    for name in TRACKING_FIGURES:
        (documents / name).unlink(missing_ok=True)
        if f"](figures/{name})" in report:
            shutil.copyfile(out / "figures" / name, documents / name)
    (documents / "tracking.md").write_text(report.replace("](figures/", "]("), encoding="utf-8")


def tracking_sections(report: str) -> dict[str, str]:
    """The facts, figures and tables of a `tracking.md` by the names of their markers."""
    head, *sections = report.split("\n## ")
    lines = head.splitlines()
    parts = {"tracking-runs": "\n".join(line for line in lines if line.startswith("* "))}
    for line in lines:
        if line.startswith("!["):
            name = line[2:].partition("]")[0]
            parts[f"tracking-figure-{name}"] = line.replace("](", "](tracking/")
    for section in sections:
        title, _, body = section.partition("\n")
        parts[f"tracking-{title.lower().replace(' ', '-')}"] = body.strip()
    return parts


def with_tracking(document: str, report: str) -> str:
    """`document` with every part of the report between its markers; parts that were not run say so."""
    parts = tracking_sections(report)
    for name in _SECTION.findall(document):
        document = insert(document, parts.get(name, _NOT_RUN), name)
    return document


def main(out: Path, tracking: Path | None = None) -> None:
    """Update docs/bench and the README, and with a tracking report docs/tracking, below the current folder."""
    copy_report(out, Path("docs/bench"))
    readme = Path("README.md")
    text = summary(Path("docs/bench/bench.md").read_text(encoding="utf-8"))
    readme.write_text(insert(readme.read_text(encoding="utf-8"), text), encoding="utf-8")
    if tracking is not None:
        update_tracking(tracking)


def update_tracking(out: Path) -> None:
    """Update docs/tracking and docs/tracking.md below the current folder."""
    copy_tracking(out, Path("docs/tracking"))
    report = Path("docs/tracking/tracking.md").read_text(encoding="utf-8")
    page = Path("docs/tracking.md")
    page.write_text(with_tracking(page.read_text(encoding="utf-8"), report), encoding="utf-8")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
