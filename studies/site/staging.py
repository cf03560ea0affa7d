"""Write all pages of the site to one folder, as plain Markdown for any site generator.

Run as ``python -m studies.site.staging OUT``, from the top of the repository.
"""

from __future__ import annotations

import posixpath
import re
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from latex2mathml.converter import convert

from diffdrive_mpc.models.checked_yaml import ConfigError
from studies.site.notebooks import with_notebooks
from studies.site.reference import reference_pages

MOVED = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
"""Documents outside `docs`, and their names on the site."""

_PACKAGE_PAGE = re.compile(r"packages/(\w+)/docs/(.*)")
_LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?(\))")
_COMMENT = re.compile(r"<!--.*?-->\n?", re.DOTALL)
_FENCED = re.compile(r"^(```.*?^```)$", re.MULTILINE | re.DOTALL)


def place_on_site(path: str) -> str:
    """Return the path on the site of a repository file; both paths are relative to the top folder, with slashes."""
    if path in MOVED:
        return MOVED[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if match := _PACKAGE_PAGE.fullmatch(path):
        return f"{match[1]}/{match[2]}"
    return f"files/{path}.md"


def linked_files(markdown: str, document: str) -> set[str]:
    """Collect the repository files that a `document` links to; paths are relative to the top folder, with slashes."""
    return {_resolve(target, document) for _, target, *_ in _LINK.findall(_FENCED.sub("", markdown))}


def with_site_links(markdown: str, document: str) -> str:
    """Convert the links in a repository `document` to links on the site, and remove comments."""
    folder = posixpath.dirname(place_on_site(document)) or "."

    def site_link(match: re.Match[str]) -> str:
        before, target, anchor, after = match.groups()
        site_path = place_on_site(_resolve(target, document))
        return f"{before}{posixpath.relpath(site_path, folder)}{anchor or ''}{after}"

    parts = _FENCED.split(_COMMENT.sub("", markdown))
    return "".join(part if part.startswith("```") else _LINK.sub(site_link, part) for part in parts)


def page_of_file(path: str, text: str) -> str:
    """Format a page with the text of a file that is not Markdown."""
    kind = {".py": "python", ".yaml": "yaml", ".cff": "yaml", ".json": "json"}.get(Path(path).suffix, "text")
    return f"# {path}\n\n```{kind}\n{text.rstrip()}\n```\n"


def pages_outside(root: Path, documents: Mapping[str, str]) -> dict[str, str]:
    """Build the pages of the files in `MOVED`, and of the files that `documents` (text by path) link to.

    The keys of the result are paths on the site. Missing files are omitted; the strict build of the site then reports
    the page with the link.
    """
    moved = {name: (root / name).read_text(encoding="utf-8") for name in MOVED}
    linked = {path for name, text in {**documents, **moved}.items() for path in linked_files(text, name)}
    paths = {path for path in linked if place_on_site(path).startswith("files/") and (root / path).is_file()}
    file_pages = {place_on_site(path): page_of_file(path, (root / path).read_text(encoding="utf-8")) for path in paths}
    moved_pages = {MOVED[name]: with_site_links(text, name) for name, text in moved.items()}
    return {**file_pages, **moved_pages, "index.md": f"---\nhide: [navigation]\n---\n\n{moved_pages['index.md']}"}


def _resolve(target: str, document: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(document), target))


_CODE_OR_FORMULA = re.compile(
    r"(?P<code>^```.*?^```$|^ {4}[^\n]*$|`[^`\n]+`)|\$\$(?P<block>.+?)\$\$|\$(?P<inline>[^\s$](?:[^$\n]*[^\s$])?)\$",
    re.MULTILINE | re.DOTALL,
)


def with_mathml(markdown: str) -> str:
    """Convert the formulas of a page to MathML; for invalid TeX, raise the errors of `latex2mathml`."""
    return _CODE_OR_FORMULA.sub(_mathml, markdown)


def _mathml(match: re.Match[str]) -> str:
    if match["code"]:
        return match[0]
    is_block = match["block"] is not None
    mathml = str(convert((match["block"] or match["inline"]).strip(), display="block" if is_block else "inline"))
    # Markdown also parses the text inside tags, where a star or an underscore would start an emphasis.
    return mathml.replace("*", "&#42;").replace("_", "&#95;")


_LABORATORY = "laboratory/index.html"


def stage(root: Path, out: Path) -> None:
    """Write the documents of the repository at `root`, the laboratory, and pages generated from the code to `out`.

    Previous content of `out` is removed. Links point to pages of the site, and formulas are MathML.

    Raises ConfigError if `out` is a folder that was not written by this function.
    """
    if out.exists() and not (out / _LABORATORY).is_file():
        raise ConfigError(f"{out}: not a folder of the site, because {_LABORATORY} is missing; choose another folder")
    pages = [*(root / "docs").rglob("*.md"), *root.glob("packages/*/docs/*.md")]
    documents = {path.relative_to(root).as_posix(): path.read_text(encoding="utf-8") for path in sorted(pages)}
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(root / "docs", out, ignore=shutil.ignore_patterns("*.md"))
    documents = with_notebooks(documents, out)
    linked = {name: with_site_links(text, name) for name, text in documents.items()}
    pages_of_documents = {place_on_site(name): text for name, text in linked.items()}
    for site_path, text in {**pages_of_documents, **pages_outside(root, documents), **reference_pages(linked)}.items():
        page = out / site_path
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(with_mathml(text), encoding="utf-8")


if __name__ == "__main__":
    stage(Path(), Path(sys.argv[1]))
