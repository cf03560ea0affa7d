"""Table of the dependencies of this package and their licences: `python -m studies.site.licences`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement

from studies.documents.documents import insert

PAGE = Path(__file__).resolve().parents[2] / "docs" / "install.md"
MARKER = "licences"
_OURS = "diffdrive-mpc"
_LONGEST = 60


def licence_table() -> str:
    """Tabulate every dependency of our package without extras: its stated licence, and the packages that need it."""
    needed = _dependencies()
    rows = [(name, licence(distribution), ", ".join(sorted(by))) for name, (distribution, by) in sorted(needed.items())]
    lines = ["| package | licence | needed by |", "| --- | --- | --- |"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def licence(package: Distribution) -> str:
    """Return the licence that a package states: an SPDX expression, its classifiers, or the field "License"."""
    metadata = package.metadata
    # A missing entry is None in some versions of Python, and an error in others.
    if "License-Expression" in metadata:
        return str(metadata["License-Expression"])
    classes = [
        line.rpartition(" :: ")[2]
        for line in metadata.get_all("Classifier") or ()
        if line.startswith("License ::") and line.count(" :: ") > 1
    ]
    words = (metadata.get_all("License") or [""])[0].strip().splitlines()
    if words and len(words[0]) <= _LONGEST and not classes:
        return str(words[0])
    return ", ".join(sorted(classes)) or (f"{words[0][:_LONGEST]} ..." if words else "not stated; see its sources")


def _dependencies() -> dict[str, tuple[Distribution, set[str]]]:
    """Collect the dependencies of our package by normalised name, each with the packages that need it."""
    distributions: dict[str, tuple[Distribution, set[str]]] = {}
    todo = [(_OURS, distribution(_OURS), frozenset[str]())]
    done: set[tuple[str, frozenset[str]]] = set()
    while todo:
        by, package, extras = todo.pop()
        for requirement in _requirements(package, extras):
            name = _normal(requirement.name)
            try:
                needed = distribution(name)
            except PackageNotFoundError:
                continue  # not for this processor
            distributions.setdefault(name, (needed, set()))[1].add(_normal(by))
            key = (name, frozenset(requirement.extras))
            if key not in done:
                done.add(key)
                todo.append((name, needed, key[1]))
    return distributions


def _requirements(package: Distribution, extras: frozenset[str]) -> Iterator[Requirement]:
    for text in package.requires or ():
        requirement = Requirement(text)
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            yield requirement


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def with_table(page: str) -> str:
    """Update the table in `page`."""
    return insert(page, licence_table(), MARKER)


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
