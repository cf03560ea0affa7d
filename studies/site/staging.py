"""Write all pages of the site to one folder, as plain Markdown for any site generator.

`python -m studies.site.staging OUT`, run in the root folder of the repository, writes the pages to OUT.
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

TOP_DOCUMENTS = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
"""Paths on the site of documents outside `docs`."""

_PACKAGE_PAGE = re.compile(r"packages/(\w+)/docs/(.*)")
_LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?(\))")
_COMMENT = re.compile(r"<!--.*?-->\n?", re.DOTALL)
_FENCED = re.compile(r"^(```.*?^```)$", re.MULTILINE | re.DOTALL)


def page_path(path: str) -> str:
    """Return the path on the site of a repository file; both paths are relative to the root folder, with slashes."""
    if path in TOP_DOCUMENTS:
        return TOP_DOCUMENTS[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if match := _PACKAGE_PAGE.fullmatch(path):
        return f"{match[1]}/{match[2]}"
    return f"files/{path}.md"


def linked_files(markdown: str, document: str) -> set[str]:
    """Collect the repository files to which a `document` links; paths are relative to the root folder, with slashes."""
    return {_resolve(target, document) for _, target, *_ in _LINK.findall(_FENCED.sub("", markdown))}


def with_site_links(markdown: str, document: str) -> str:
    """Convert the links in a repository `document` to links on the site, and remove its comments."""
    folder = posixpath.dirname(page_path(document)) or "."

    def site_link(match: re.Match[str]) -> str:
        before, target, anchor, after = match.groups()
        target_page = page_path(_resolve(target, document))
        return f"{before}{posixpath.relpath(target_page, folder)}{anchor or ''}{after}"

    parts = _FENCED.split(_COMMENT.sub("", markdown))
    return "".join(part if part.startswith("```") else _LINK.sub(site_link, part) for part in parts)


def page_of_file(path: str, text: str) -> str:
    """Format a page with the text of a file that is not Markdown."""
    kind = {".py": "python", ".yaml": "yaml", ".cff": "yaml", ".json": "json"}.get(Path(path).suffix, "text")
    return f"# {path}\n\n```{kind}\n{text.rstrip()}\n```\n"


def pages_outside(root: Path, documents: Mapping[str, str]) -> dict[str, str]:
    """Build the pages of the files in `TOP_DOCUMENTS`, and of the files to which `documents` (text by path) link.

    The keys of the result are paths on the site. Missing files are omitted; the strict build of the site then reports
    the page with the invalid link.
    """
    top_documents = {name: (root / name).read_text(encoding="utf-8") for name in TOP_DOCUMENTS}
    linked = {path for name, text in {**documents, **top_documents}.items() for path in linked_files(text, name)}
    paths = {path for path in linked if page_path(path).startswith("files/") and (root / path).is_file()}
    file_pages = {page_path(path): page_of_file(path, (root / path).read_text(encoding="utf-8")) for path in paths}
    moved_pages = {TOP_DOCUMENTS[name]: with_site_links(text, name) for name, text in top_documents.items()}
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
    # Markdown also parses the text inside tags, where an asterisk or an underscore would start an emphasis.
    return mathml.replace("*", "&#42;").replace("_", "&#95;")


_LABORATORY = "laboratory/index.html"


def stage(root: Path, out: Path) -> None:
    """Write the documents of the repository at `root`, the laboratory, and pages generated from the code to `out`.

    Previous content of `out` is removed. Links are converted to links on the site, and formulas to MathML.

    Raise ConfigError if `out` is a folder that this function did not write.
    """
    if out.exists() and not (out / _LABORATORY).is_file():
        raise ConfigError(f"{out}: not a folder of the site, because {_LABORATORY} is missing; choose another folder")
    pages = [*(root / "docs").rglob("*.md"), *root.glob("packages/*/docs/*.md")]
    documents = {path.relative_to(root).as_posix(): path.read_text(encoding="utf-8") for path in sorted(pages)}
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(root / "docs", out, ignore=shutil.ignore_patterns("*.md"))
    documents = with_notebooks(documents, out)
    linked = {name: with_site_links(text, name) for name, text in documents.items()}
    pages_of_documents = {page_path(name): text for name, text in linked.items()}
    for path_on_site, text in {
        **pages_of_documents,
        **pages_outside(root, documents),
        **reference_pages(linked),
    }.items():
        page = out / path_on_site
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(with_mathml(text), encoding="utf-8")


if __name__ == "__main__":
    stage(Path(), Path(sys.argv[1]))
