"""Copy the tables and figures of a bench run into the documents, so that they show what the command produced.

Run as ``python -m bench.documents OUT``, from the top of the repository.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from models.checked_yaml import ConfigError

COPIED = ("bench.md", "bench.json", "figures/overview.png", "figures/horizon.png")
"""What the documents show of a report."""
_BEGIN, _END = "<!-- bench:begin -->", "<!-- bench:end -->"


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


def insert(document: str, text: str) -> str:
    """`document` with `text` between its markers."""
    before, rest = document.split(_BEGIN, 1)
    return f"{before}{_BEGIN}\n{text}\n{_END}{rest.split(_END, 1)[1]}"


def main(out: Path) -> None:
    """Update docs/bench and the README below the current folder."""
    copy_report(out, Path("docs/bench"))
    readme = Path("README.md")
    text = summary(Path("docs/bench/bench.md").read_text(encoding="utf-8"))
    readme.write_text(insert(readme.read_text(encoding="utf-8"), text), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
