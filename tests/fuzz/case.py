"""Fuzzers, their findings, and the files of findings, one per fuzzer."""

from __future__ import annotations

import hashlib
import json
import traceback
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Finding:
    """Case that breaks a promise."""

    fuzzer: str
    description: str
    signature: str
    case: Case

    def save(self, folder: Path = FINDINGS) -> Path:
        """Add the case to the file of its fuzzer, under a mark that follows from its signature."""
        mark = hashlib.sha256(self.signature.encode()).hexdigest()[:8]
        path = folder / f"{self.fuzzer}.json"
        findings = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        findings[mark] = {"what": self.description, "case": self.case}
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(findings, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        return path


def saved_findings(folder: Path = FINDINGS) -> dict[tuple[str, str], Case]:
    """Return the cases of a folder by fuzzer and mark."""
    files = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))}
    return {(fuzzer, mark): entry["case"] for fuzzer, cases in files.items() for mark, entry in cases.items()}


def draw(fuzzer: Fuzzer, seed: int, index: int) -> Case:
    """Draw case number `index` of `seed`, which is the same on every machine."""
    return fuzzer.draw(Random(f"{fuzzer.name}/{seed}/{index}"))


def trouble(fuzzer: Fuzzer, case: Case) -> tuple[str, str] | None:
    """Check a case; return description and signature of a fault, or None."""
    try:
        fuzzer.check(case)
    except FaultError as error:
        return str(error), f"{fuzzer.name}: {str(error).partition(':')[0]}"
    except (KeyboardInterrupt, HangError):
        raise
    except BaseException as error:  # SystemExit of a library, too
        where = _innermost(error)
        return f"{type(error).__name__}: {error}, at {where}", f"{fuzzer.name}: {type(error).__name__} at {where}"
    return None


def _innermost(error: BaseException) -> str:
    """Return the innermost function of the product, without its line, which changes."""
    frames = [
        frame for frame in traceback.extract_tb(error.__traceback__) if "diffdrive_mpc" in frame.filename
    ] or traceback.extract_tb(error.__traceback__)
    return f"{Path(frames[-1].filename).name}, {frames[-1].name}" if frames else "nowhere"
