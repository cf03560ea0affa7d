"""Write all pages of the site into one folder, as plain Markdown for any site generator.

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
    """Return the path on the site of a file of the repository; both paths are relative to the top, with slashes."""
    if path in MOVED:
        return MOVED[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if match := _PACKAGE_PAGE.fullmatch(path):
        return f"{match[1]}/{match[2]}"
    return f"files/{path}.md"


def linked_files(markdown: str, document: str) -> set[str]:
    """List the files of the repository that a `document` links to; paths are relative to the top, with slashes."""
    return {_resolve(target, document) for _, target, *_ in _LINK.findall(_FENCED.sub("", markdown))}


def with_site_links(markdown: str, document: str) -> str:
    """Convert the links in a `document` of the repository to links on the site, and remove comments."""
    folder = posixpath.dirname(place_on_site(document)) or "."

    def site_link(match: re.Match[str]) -> str:
        before, target, anchor, after = match.groups()
        place = place_on_site(_resolve(target, document))
        return f"{before}{posixpath.relpath(place, folder)}{anchor or ''}{after}"

    parts = _FENCED.split(_COMMENT.sub("", markdown))
    return "".join(part if part.startswith("```") else _LINK.sub(site_link, part) for part in parts)


def page_of_file(path: str, text: str) -> str:
    """Format a page with the text of a file that is no Markdown."""
    kind = {".py": "python", ".yaml": "yaml", ".cff": "yaml", ".json": "json"}.get(Path(path).suffix, "text")
    return f"# {path}\n\n```{kind}\n{text.rstrip()}\n```\n"


def pages_outside(root: Path, documents: Mapping[str, str]) -> dict[str, str]:
    """Build pages by path on the site for files in `MOVED`, and for files that the `documents` (text by path) link to.

    A missing file is omitted: the strict build then reports the page that links to it.
    """
    moved = {name: (root / name).read_text(encoding="utf-8") for name in MOVED}
    linked = {path for name, text in {**documents, **moved}.items() for path in linked_files(text, name)}
    outside = {path for path in linked if place_on_site(path).startswith("files/") and (root / path).is_file()}
    shown = {place_on_site(path): page_of_file(path, (root / path).read_text(encoding="utf-8")) for path in outside}
    whole = {MOVED[name]: with_site_links(text, name) for name, text in moved.items()}
    return {**shown, **whole, "index.md": f"---\nhide: [navigation]\n---\n\n{whole['index.md']}"}


def _resolve(target: str, document: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(document), target))


_CODE_OR_FORMULA = re.compile(
    r"(?P<code>^```.*?^```$|^ {4}[^\n]*$|`[^`\n]+`)|\$\$(?P<block>.+?)\$\$|\$(?P<inline>[^\s$](?:[^$\n]*[^\s$])?)\$",
    re.MULTILINE | re.DOTALL,
)


def with_mathml(markdown: str) -> str:
    """Convert the formulas of a page to MathML; raise the errors of `convert` for invalid TeX."""
    return _CODE_OR_FORMULA.sub(_mathml, markdown)


def _mathml(match: re.Match[str]) -> str:
    if match["code"]:
        return match[0]
    block = match["block"] is not None
    mathml = str(convert((match["block"] or match["inline"]).strip(), display="block" if block else "inline"))
    # Markdown also parses the text of tags: a star or an underscore would start an emphasis.
    return mathml.replace("*", "&#42;").replace("_", "&#95;")


_LABORATORY = "laboratory/index.html"


def stage(root: Path, out: Path) -> None:
    """Write the documents of the repository at `root`, the laboratory, and pages generated from the code to `out`.

    Earlier content of `out` is removed. Links lead to pages of the site, and formulas are MathML.

    Raises ConfigError if `out` is a folder that was not written by this function.
    """
    if out.exists() and not (out / _LABORATORY).is_file():
        raise ConfigError(f"{out}: it has no {_LABORATORY}, so it is no folder of the site; give another folder")
    pages = [*(root / "docs").rglob("*.md"), *root.glob("packages/*/docs/*.md")]
    documents = {path.relative_to(root).as_posix(): path.read_text(encoding="utf-8") for path in sorted(pages)}
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(root / "docs", out, ignore=shutil.ignore_patterns("*.md"))
    documents = with_notebooks(documents, out)
    linked = {name: with_site_links(text, name) for name, text in documents.items()}
    ours = {place_on_site(name): text for name, text in linked.items()}
    for place, text in {**ours, **pages_outside(root, documents), **reference_pages(linked)}.items():
        page = out / place
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(with_mathml(text), encoding="utf-8")


if __name__ == "__main__":
    stage(Path(), Path(sys.argv[1]))
