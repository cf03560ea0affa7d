"""Links of the documents, which lead to files of the repository, as links of the site."""

from __future__ import annotations

import html
import posixpath
import re
from collections.abc import Iterator, Mapping
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from latex2mathml.converter import convert
from packaging.requirements import Requirement

from studies.documents.documents import insert

MOVED = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
"""Documents that lie outside `docs`, and what they are called on the site."""

_LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?(\))")
_COMMENT = re.compile(r"<!--.*?-->\n?", re.DOTALL)
_FENCED = re.compile(r"^(```.*?^```)$", re.MULTILINE | re.DOTALL)


def place_on_site(path: str) -> str:
    """Where a file of the repository is on the site, both as paths with slashes from the top."""
    if path in MOVED:
        return MOVED[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return f"files/{path}.md"


def linked_files(markdown: str, document: str) -> set[str]:
    """Files of the repository that a `document` links to, both as paths with slashes from the top."""
    return {_resolved(target, document) for _, target, *_ in _LINK.findall(_FENCED.sub("", markdown))}


def with_site_links(markdown: str, document: str) -> str:
    """The text of a `document` of the repository with its links as they are on the site, and without comments."""
    folder = posixpath.dirname(place_on_site(document)) or "."

    def moved(found: re.Match[str]) -> str:
        before, target, anchor, after = found.groups()
        place = place_on_site(_resolved(target, document))
        return f"{before}{posixpath.relpath(place, folder)}{anchor or ''}{after}"

    parts = _FENCED.split(_COMMENT.sub("", markdown))
    return "".join(part if part.startswith("```") else _LINK.sub(moved, part) for part in parts)


def page_of_file(path: str, text: str) -> str:
    """A page that shows a file which is no Markdown."""
    kind = {".py": "python", ".yaml": "yaml", ".cff": "yaml", ".json": "json"}.get(Path(path).suffix, "text")
    return f"# {path}\n\n```{kind}\n{text.rstrip()}\n```\n"


def pages_outside(root: Path, documents: Mapping[str, str]) -> dict[str, str]:
    """Markdown by place on the site, for what the `documents` (text by path) link to and for those in `MOVED`.

    A file that a link names and that does not exist is left out: the strict build then says which page links to it.
    """
    moved = {name: (root / name).read_text(encoding="utf-8") for name in MOVED}
    linked = {path for name, text in {**documents, **moved}.items() for path in linked_files(text, name)}
    outside = {path for path in linked if place_on_site(path).startswith("files/") and (root / path).is_file()}
    shown = {place_on_site(path): page_of_file(path, (root / path).read_text(encoding="utf-8")) for path in outside}
    whole = {MOVED[name]: with_site_links(text, name) for name, text in moved.items()}
    return {**shown, **whole, "index.md": f"---\nhide: [navigation]\n---\n\n{whole['index.md']}"}


def _resolved(target: str, document: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(document), target))


# TeX between dollar signs, as code hosts render it, as MathML, which browsers render by themselves.


# What pymdownx.arithmatex makes of $...$ and $$...$$ in its generic form.
_MARKED = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def with_mathml(page: str) -> str:
    """The HTML of a page with its formulas as MathML; raises what `convert` does where it does not understand one."""
    return _MARKED.sub(_mathml, page)


def _mathml(found: re.Match[str]) -> str:
    _, bracket, tex = found.groups()
    return str(convert(html.unescape(tex).strip(), display="block" if bracket == "[" else "inline"))


# Table of the packages that come with this one, and their licences: `python -m studies.site.repository_links`.


PAGE = Path(__file__).resolve().parents[2] / "docs" / "licences.md"
MARKER = "licences"
_OURS = "diffdrive-mpc"
_LONGEST = 60


def licence_table() -> str:
    """Every package that is installed with ours, without extras: its licence as it states it, and who needs it."""
    needed = _needed()
    rows = [(name, licence(found), ", ".join(sorted(by))) for name, (found, by) in sorted(needed.items())]
    lines = ["| package | licence | needed by |", "| --- | --- | --- |"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def licence(package: Distribution) -> str:
    """What a package says of its licence: an SPDX expression, its classifiers, or the words of its field."""
    said = package.metadata
    # What is not there is None in some Pythons, and an error in others.
    if "License-Expression" in said:
        return str(said["License-Expression"])
    classes = [
        line.rpartition(" :: ")[2]
        for line in said.get_all("Classifier") or ()
        if line.startswith("License ::") and line.count(" :: ") > 1
    ]
    words = (said.get_all("License") or [""])[0].strip().splitlines()
    if words and len(words[0]) <= _LONGEST and not classes:
        return str(words[0])
    return ", ".join(sorted(classes)) or (f"{words[0][:_LONGEST]} ..." if words else "not stated; see its sources")


def _needed() -> dict[str, tuple[Distribution, set[str]]]:
    """Packages by their normal name, with those that need them, from ours on."""
    found: dict[str, tuple[Distribution, set[str]]] = {}
    todo = [(_OURS, distribution(_OURS), frozenset[str]())]
    done: set[tuple[str, frozenset[str]]] = set()
    while todo:
        by, package, extras = todo.pop()
        for one in _requirements(package, extras):
            name = _normal(one.name)
            try:
                needed = distribution(name)
            except PackageNotFoundError:
                continue  # not for this processor
            found.setdefault(name, (needed, set()))[1].add(_normal(by))
            key = (name, frozenset(one.extras))
            if key not in done:
                done.add(key)
                todo.append((name, needed, key[1]))
    return found


def _requirements(package: Distribution, extras: frozenset[str]) -> Iterator[Requirement]:
    for text in package.requires or ():
        one = Requirement(text)
        if one.marker is None or any(one.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            yield one


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def with_table(page: str) -> str:
    """`page` with the table as it is now."""
    return insert(page, licence_table(), MARKER)


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
