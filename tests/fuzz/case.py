"""Fuzzers, and the files of their findings, one per fuzzer."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from random import Random
from typing import Any, Protocol

FINDINGS = Path(__file__).parent / "findings"

Case = Any
"""A value that JSON can hold, with NaN and infinities as Python writes them."""


class FaultError(AssertionError):
    """Broken promise of the product; the words before the colon name it."""


class HangError(BaseException):
    """Time limit of a case; no Exception, so that the product does not catch it."""


class Fuzzer(Protocol):
    """Input of the product and its odd cases.

    Attributes
    ----------
    name
        On the command line, and of the file of its findings.
    longest
        Time that a case may take [s].
    count
        Cases of a short run.
    """

    name: str
    longest: float
    count: int

    def draw(self, random: Random) -> Case:
        """Draw a case."""
        ...

    def check(self, case: Case) -> None:
        """Raise FaultError or an error of the product if a promise is broken."""
        ...


def save(fuzzer: str, description: str, case: Case, folder: Path = FINDINGS) -> Path:
    """Add a case to the file of its fuzzer, under a mark that follows from the case."""
    mark = hashlib.sha256(json.dumps(case).encode()).hexdigest()[:8]
    path = folder / f"{fuzzer}.json"
    findings = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    findings[mark] = {"what": description, "case": case}
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(findings, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return path


def saved_findings(folder: Path = FINDINGS) -> dict[tuple[str, str], Case]:
    """Return the cases of a folder by fuzzer and mark."""
    files = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))}
    return {(fuzzer, mark): entry["case"] for fuzzer, cases in files.items() for mark, entry in cases.items()}


def draw(fuzzer: Fuzzer, seed: int | str, index: int) -> Case:
    """Draw case number `index` of `seed` without Hypothesis."""
    return fuzzer.draw(Random(f"{fuzzer.name}/{seed}/{index}"))
