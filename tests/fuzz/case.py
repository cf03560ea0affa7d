"""What a fuzzer is, what it finds, and the files that findings are kept in, one for each fuzzer."""

from __future__ import annotations

import hashlib
import json
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Protocol

FINDINGS = Path(__file__).parent / "findings"

Case = Any
"""A value that JSON can hold, with NaN and infinities as Python writes them."""


class FaultError(AssertionError):
    """The product broke a promise; the first word before the colon says which."""


class HangError(BaseException):
    """A case takes too long. No Exception, so that nothing under test takes it for one of its own."""


class Fuzzer(Protocol):
    """One door of the product, and what may come through it.

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
        """A case."""
        ...

    def check(self, case: Case) -> None:
        """Raise FaultError, or whatever the product lets out, where it breaks a promise."""
        ...

    def simpler(self, case: Case) -> Iterator[Case]:
        """Cases that are a little simpler, the boldest first."""
        ...


@dataclass(frozen=True)
class Finding:
    """A case that breaks a promise."""

    fuzzer: str
    what: str
    signature: str
    case: Case

    def save(self, folder: Path = FINDINGS) -> Path:
        """Add it to the file of its fuzzer, under a mark that follows from its signature."""
        mark = hashlib.sha256(self.signature.encode()).hexdigest()[:8]
        path = folder / f"{self.fuzzer}.json"
        kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        kept[mark] = {"what": self.what, "case": self.case}
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        return path


def saved_findings(folder: Path = FINDINGS) -> dict[tuple[str, str], Case]:
    """Cases by fuzzer and mark."""
    files = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))}
    return {(fuzzer, mark): entry["case"] for fuzzer, kept in files.items() for mark, entry in kept.items()}


def draw(fuzzer: Fuzzer, seed: int, index: int) -> Case:
    """Case number `index` of `seed`: the same on every machine, whatever was drawn before."""
    return fuzzer.draw(Random(f"{fuzzer.name}/{seed}/{index}"))


def trouble(fuzzer: Fuzzer, case: Case) -> tuple[str, str] | None:
    """What is wrong with a case, and by what to recognise it: None where nothing is."""
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
    """Function of the product that let it out; without its line, which moves with every change."""
    frames = [
        frame for frame in traceback.extract_tb(error.__traceback__) if "diffdrive_mpc" in frame.filename
    ] or traceback.extract_tb(error.__traceback__)
    return f"{Path(frames[-1].filename).name}, {frames[-1].name}" if frames else "nowhere"
