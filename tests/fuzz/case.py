"""Interface of the fuzzers, and the files of their findings."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from random import Random
from typing import Any, Protocol

FINDINGS = Path(__file__).parent / "findings"

Case = Any
"""JSON value, with NaN and infinities as written by Python."""


class FaultError(AssertionError):
    """Violation of a guarantee of the project; the message starts with the name of the guarantee and a colon."""


class DeadlineError(FaultError):
    """Step that takes longer than its sample; other processes can cause it, so a repetition must confirm it."""


class HangError(BaseException):
    """Exceeded time limit of a case; derived from BaseException, so that the project does not catch it."""


class Fuzzer(Protocol):
    """Fuzzer of one kind of input.

    Attributes
    ----------
    name
        Name on the command line and of the file of its findings.
    time_limit
        Maximum duration of a case [s].
    count
        Number of cases of a short run.
    """

    name: str
    time_limit: float
    count: int

    def draw(self, random: Random) -> Case:
        """Draw a case."""
        ...

    def check(self, case: Case) -> None:
        """Raise FaultError or an error of the project if a guarantee is violated."""
        ...


def save(fuzzer: str, description: str, case: Case) -> Path:
    """Add a case to the file of its fuzzer, by the digest of the case."""
    digest = hashlib.sha256(json.dumps(case).encode()).hexdigest()[:8]
    path = FINDINGS / f"{fuzzer}.json"
    findings = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    findings[digest] = {"what": description, "case": case}
    path.write_text(json.dumps(findings, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return path


def saved_findings(folder: Path = FINDINGS) -> dict[tuple[str, str], Case]:
    """Return the cases of a folder by fuzzer and digest."""
    files = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))}
    return {(fuzzer, digest): entry["case"] for fuzzer, cases in files.items() for digest, entry in cases.items()}


def draw(fuzzer: Fuzzer, seed: int | str, index: int) -> Case:
    """Draw case number `index` of `seed` without Hypothesis."""
    return fuzzer.draw(Random(f"{fuzzer.name}/{seed}/{index}"))
