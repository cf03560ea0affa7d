"""Write all pages of the site into one folder, as plain Markdown that any generator of sites takes.

Run as ``python -m studies.site.staging OUT``, from the top of the repository.
"""

from __future__ import annotations

import logging
import shutil
import sys
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc_lab.build import has_compiler, page_text
from studies.site.formulas import with_mathml
from studies.site.notebooks import with_notebooks
from studies.site.reference import reference_pages
from studies.site.repository_links import pages_outside, with_site_links

_LABORATORY = "lab.html"
_NO_COMPILER = "the laboratory is not on this site: its compiler is not installed (make lab installs it)"


def stage(root: Path, out: Path) -> None:
    """Write the documents of the repository at `root`, the pages made from its code, and the laboratory to `out`.

    What was in `out` before is removed. Links lead to pages of the site, and formulas are MathML.

    Raises ConfigError if `out` is a folder that was not written by this.
    """
    if out.exists() and not (out / _LABORATORY).is_file():
        raise ConfigError(f"{out}: has no {_LABORATORY}, so it is no folder of the site's pages; name another")
    documents = {
        f"docs/{path.relative_to(root / 'docs').as_posix()}": path.read_text(encoding="utf-8")
        for path in sorted((root / "docs").rglob("*.md"))
    }
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(root / "docs", out, ignore=shutil.ignore_patterns("*.md"))
    documents = with_notebooks(documents, out)
    ours = {name.removeprefix("docs/"): with_site_links(text, name) for name, text in documents.items()}
    for place, text in {**ours, **pages_outside(root, documents), **reference_pages(documents)}.items():
        page = out / place
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(with_mathml(text), encoding="utf-8")
    (out / _LABORATORY).write_text(laboratory_page(), encoding="utf-8")


def laboratory_page() -> str:
    """The page of the laboratory, or a line in its place where its compiler is not installed."""
    if has_compiler():
        return page_text()
    logging.getLogger(__name__).warning(_NO_COMPILER)
    head = "<!DOCTYPE html><html lang=en><meta name=viewport content=width=device-width><title>Laboratory</title>"
    return f"{head}<p>{_NO_COMPILER}</p></html>"


if __name__ == "__main__":
    stage(Path(), Path(sys.argv[1]))
