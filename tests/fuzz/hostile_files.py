"""Hostile files of all kinds: each is read, or refused with one line, within bounds of time, memory and space."""

from __future__ import annotations

import gc
import os
import resource
import signal
import tempfile
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import NoReturn

from fuzz.hostile_texts import TEXTS, Maker

SECONDS, MEMORY, TEMPORARY = 5.0, 1000.0, 64.0
"""Bounds: processor time [s], peak memory [MB], temporary space [MB]."""
_HANGS = 60.0
"""Time after which a reader is killed [s]."""

MAKERS: dict[str, Maker] = TEXTS
"""By name `door: kind of attack`; each writes a file and returns its path."""


def doors() -> dict[str, Callable[[Path], object]]:
    """Return the readers by the name of their door."""
    from diffdrive_mpc.bench.report_folder import staged
    from diffdrive_mpc.models.logs.reading import read_log
    from diffdrive_mpc.models.logs.tick_record import DriveRecord
    from fuzz.yaml_files import DOORS

    def log(path: Path) -> object:
        mapping = path.with_name("mapping.yaml")
        return read_log(path, mapping if mapping.is_file() else None)

    def report(path: Path) -> None:
        with staged(path.parent, ["report.html"], owner="bench") as folder:
            (folder / "report.html").write_text("new", encoding="utf-8")

    return {
        **DOORS,
        "log": log,
        "report": report,
        "ticks": lambda path: DriveRecord.read(path.read_text()),
    }


@dataclass(frozen=True)
class Outcome:
    """Result of one file: how its reading ended, processor time [s], memory [MB], temporary space [MB]."""

    name: str
    end: str
    seconds: float
    memory: float
    temporary: float

    def faults(self) -> list[str]:
        """Return the broken bounds."""
        _, refused, line = self.end.partition("refused: ")
        faults = [] if refused or self.end == "read" else [self.end]
        if refused and (not line.isprintable() or not 0 < len(line) <= 4000):
            faults.append(f"its line cannot be shown: {line[:200]!r}")
        bounds = {
            "s of processor time": (self.seconds, SECONDS),
            "MB of memory": (self.memory, MEMORY),
            "MB of temporary space": (self.temporary, TEMPORARY),
        }
        return faults + [f"{value:.1f} {name}" for name, (value, most) in bounds.items() if value > most]


def run(seed: int, count: int) -> list[Outcome]:
    """Make and read files; every maker comes before one comes again."""
    readers, outcomes = doors(), []
    names = [*MAKERS]
    Random(seed).shuffle(names)
    warnings.simplefilter("ignore")
    for index in range(count):
        name = names[index % len(names)]
        with tempfile.TemporaryDirectory(prefix="hostile-") as folder:
            (home := Path(folder, "made")).mkdir()
            path = MAKERS[name](Random(f"{name}/{seed}/{index}"), home)
            outcomes.append(examine(readers[name.partition(":")[0]], path, Path(folder), f"{index} {name}"))
    return outcomes


def examine(read: Callable[[Path], object], path: Path, folder: Path, name: str = "") -> Outcome:
    """Read a file in a separate process."""
    (scratch := folder / "scratch").mkdir()
    report, start, temporary = folder / "end", time.monotonic(), 0.0
    child = os.fork()
    if child == 0:
        _read_in_child(read, path, scratch, report)
    while not (ended := os.wait4(child, os.WNOHANG))[0]:
        if time.monotonic() - start > _HANGS:
            os.kill(child, signal.SIGKILL)
        temporary = max(temporary, _space(child, scratch))
        time.sleep(0.005)
    _, status, usage = ended
    end = report.read_text(encoding="utf-8", errors="replace") if report.exists() else ""
    if os.WIFSIGNALED(status):
        end = f"killed by signal {os.WTERMSIG(status)}"
    return Outcome(name, end, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3, temporary)


def _read_in_child(read: Callable[[Path], object], path: Path, scratch: Path, report: Path) -> NoReturn:
    """Read in the child, write the end to `report`, and leave."""
    from diffdrive_mpc.models.errors import DiffdriveMpcError

    gc.freeze()  # the objects of the parent are not part of the reading
    resource.setrlimit(resource.RLIMIT_AS, (6_000_000_000, 6_000_000_000))
    os.environ["TMPDIR"] = os.environ["SQLITE_TMPDIR"] = tempfile.tempdir = str(scratch)
    os.chdir(scratch)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    try:
        read(path)
        end = "read"
    except (DiffdriveMpcError, ValueError) as error:
        end = f"refused: {error}"
    except BaseException as error:
        end = f"{type(error).__name__}: {error}"
    report.write_text(end, encoding="utf-8", errors="backslashreplace")
    os._exit(0)


def _space(process: int, scratch: Path) -> float:
    """Return the size of temporary files [MB], including those that have no name any more."""
    sizes: dict[tuple[int, int], int] = {}
    with suppress(OSError):
        for path in (*scratch.rglob("*"), *Path(f"/proc/{process}/fd").iterdir()):
            with suppress(OSError):
                if path.resolve().is_relative_to(scratch):
                    state = path.stat()
                    sizes[state.st_dev, state.st_ino] = state.st_size
    return sum(sizes.values()) / 1e6
