"""Table of the dependencies of this package and their licences; `python -m studies.site.licences` updates the table."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement

from studies.documents.documents import insert

PAGE = Path(__file__).resolve().parents[2] / "docs" / "install.md"
MARKER = "licences"
_PACKAGE = "diffdrive-mpc"
_MAX_LENGTH = 60
"""Maximum number of characters of a licence; a longer text is probably the whole licence."""


def licence_table() -> str:
    """Tabulate the dependencies of this package without extras, their licences, and the packages that require them."""
    packages = _dependencies()
    rows = [(name, licence(package), ", ".join(sorted(users))) for name, (package, users) in sorted(packages.items())]
    lines = ["| package | licence | needed by |", "| --- | --- | --- |"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def licence(package: Distribution) -> str:
    """Return the licence in the metadata of a package: SPDX expression, else classifiers, else the field "License"."""
    metadata = package.metadata
    # The index operator returns None for a missing entry in some versions of Python and raises an error in others.
    if "License-Expression" in metadata:
        return str(metadata["License-Expression"])
    classifiers = [
        line.rpartition(" :: ")[2]
        for line in metadata.get_all("Classifier") or ()
        if line.startswith("License ::") and line.count(" :: ") > 1
    ]
    lines = (metadata.get_all("License") or [""])[0].strip().splitlines()
    if lines and len(lines[0]) <= _MAX_LENGTH and not classifiers:
        return str(lines[0])
    text = f"{lines[0][:_MAX_LENGTH]} ..." if lines else "not stated; see its sources"
    return ", ".join(sorted(classifiers)) or text


def _dependencies() -> dict[str, tuple[Distribution, set[str]]]:
    """Collect all dependencies of this package by normalised name, with the packages that require them."""
    distributions: dict[str, tuple[Distribution, set[str]]] = {}
    pending = [(_PACKAGE, distribution(_PACKAGE), frozenset[str]())]
    visited: set[tuple[str, frozenset[str]]] = set()
    while pending:
        dependent, package, extras = pending.pop()
        for requirement in _requirements(package, extras):
            name = _normalise(requirement.name)
            try:
                required = distribution(name)
            except PackageNotFoundError:
                continue  # not required on this platform
            distributions.setdefault(name, (required, set()))[1].add(_normalise(dependent))
            key = (name, frozenset(requirement.extras))
            if key not in visited:
                visited.add(key)
                pending.append((name, required, key[1]))
    return distributions


def _requirements(package: Distribution, extras: frozenset[str]) -> Iterator[Requirement]:
    for text in package.requires or ():
        requirement = Requirement(text)
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            yield requirement


def _normalise(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def insert_table(page: str) -> str:
    """Return the text `page` with the licence table updated."""
    return insert(page, licence_table(), MARKER)


if __name__ == "__main__":
    PAGE.write_text(insert_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
