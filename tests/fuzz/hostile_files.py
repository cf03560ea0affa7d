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
from types import FrameType
from typing import NamedTuple, NoReturn

from fuzz.hostile_bags import BAGS
from fuzz.hostile_texts import TEXTS, Maker

SECONDS, MEMORY, TEMPORARY, INTERRUPTED = 5.0, 1000.0, 64.0, 2.0
"""Bounds: processor time [s], peak memory [MB], temporary space [MB], time from Ctrl-C to the end [s]."""
LOAD = 3.0
"""Bound of the wall time without the waiting for a core, as a multiple of SECONDS: threads of libraries wait, too."""
_HANGS = 60.0
"""Time after which a reader is killed [s]."""
_SLOW = 0.5
"""Readers that take longer are read again and interrupted [s]."""
_TRIES = (0.5, 0.5, 0.4)
"""Times of Ctrl-C as shares of the first reading; the next one is tried if the reader was done, or the machine busy."""

MAKERS: dict[str, Maker] = {**BAGS, **TEXTS}
"""By name `door: kind of attack`; each writes a file and returns its path."""


def doors() -> dict[str, Callable[[Path], object]]:
    """Return the readers by the name of their door."""
    from diffdrive_mpc.bench.report_folder import staged
    from diffdrive_mpc.models.logs.reading import read_log
    from diffdrive_mpc.models.logs.tick_record import DriveRecord
    from diffdrive_mpc_extras.replay.node_log import LoggedConfigs
    from diffdrive_mpc_extras.replay.own_log import read_recording
    from fuzz.yaml_files import DOORS

    def log(path: Path) -> object:
        mapping = path.with_name("mapping.yaml")
        return read_log(path, mapping if mapping.is_file() else None)

    def replay(path: Path) -> object:
        with tempfile.TemporaryDirectory() as scratch:
            return read_recording(path, LoggedConfigs(path, Path(scratch)))

    def report(path: Path) -> None:
        with staged(path.parent, ["report.html"], owner="bench") as folder:
            (folder / "report.html").write_text("new", encoding="utf-8")

    return {
        **DOORS,
        "log": log,
        "replay": replay,
        "report": report,
        "ticks": lambda path: DriveRecord.read(path.read_text()),
    }


class Reading(NamedTuple):
    """End, processor time, wall time, waiting for a core [s], memory, temporary space [MB], time since Ctrl-C [s]."""

    end: str
    seconds: float
    wall: float
    waited: float
    memory: float
    temporary: float
    since: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """Result of one file; `interrupted` is the reading that Ctrl-C met, None if there was none."""

    name: str
    index: int
    read: Reading
    interrupted: Reading | None = None

    def faults(self) -> list[str]:
        """Return the broken bounds."""
        end, refused, line = self.read.end.partition("refused: ")
        faults = [end] if end not in ("", "read") else []
        if refused and (not line.isprintable() or not 0 < len(line) <= 4000):
            faults.append(f"its line cannot be shown: {line[:200]!r}")
        if self.interrupted and self.interrupted.end != "interrupted":
            faults.append(f"Ctrl-C has no effect: {self.interrupted.end}")
        bounds = {
            "s of processor time": (self.read.seconds, SECONDS),
            "s of wall time": (self.read.wall - self.read.waited, LOAD * SECONDS),
            "MB of memory": (self.read.memory, MEMORY),
            "MB of temporary space": (self.read.temporary, TEMPORARY),
            "s from Ctrl-C to its end, without waiting for a core": (
                self.interrupted.since if self.interrupted else 0.0,
                INTERRUPTED,
            ),
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
            outcomes.append(examine(readers[name.partition(":")[0]], path, Path(folder), name, index))
    return outcomes


def examine(read: Callable[[Path], object], path: Path, folder: Path, name: str = "", index: int = 0) -> Outcome:
    """Read a file in a process of its own, and once more with Ctrl-C if that takes long."""
    first, met, lost = _in_child(read, path, folder), None, list[Reading]()
    for share in _TRIES if first.wall > _SLOW and first.end != "hangs" else ():
        second = _in_child(read, path, folder, share * first.wall)
        if second.end == "interrupted":
            met = second if met is None or met.end != "interrupted" or second.since < met.since else met
            if met.since <= INTERRUPTED:
                break
        elif second.end == "hangs" or second.end.startswith("Ctrl-C"):
            lost.append(second)
    # A signal in a destructor or after the end is lost; a reader that swallows Ctrl-C does so at each try.
    return Outcome(name, index, first, lost[-1] if met is None and len(lost) == len(_TRIES) else met)


def _in_child(read: Callable[[Path], object], path: Path, folder: Path, interrupt: float = 2 * _HANGS) -> Reading:
    (scratch := folder / "scratch").mkdir(exist_ok=True)
    (report := folder / "end").unlink(missing_ok=True)
    started, sent, temporary, waited = time.monotonic(), 0.0, 0.0, 0.0
    child = os.fork()
    if child == 0:
        _inside(read, path, scratch, report)
    while not (ended := os.wait4(child, os.WNOHANG))[0]:
        now = time.monotonic() - started
        if now - waited > _HANGS:
            os.kill(child, signal.SIGKILL)
        elif now > interrupt and not sent:
            sent = now - waited
            os.kill(child, signal.SIGINT)
        temporary = max(temporary, _space(child, scratch))
        with suppress(OSError):  # from Linux only
            waited = 1e-9 * int(Path(f"/proc/{child}/schedstat").read_text().split()[1])
        time.sleep(0.005)
    _, status, usage = ended
    wall = time.monotonic() - started
    end = report.read_text(encoding="utf-8", errors="replace") if report.exists() else ""
    if os.WIFSIGNALED(status):
        end = "hangs" if wall - waited > _HANGS else f"killed by signal {os.WTERMSIG(status)}"
    return Reading(
        end, usage.ru_utime + usage.ru_stime, wall, waited, usage.ru_maxrss / 1e3, temporary, wall - waited - sent
    )


def _inside(read: Callable[[Path], object], path: Path, scratch: Path, report: Path) -> NoReturn:
    """Read in the child, write the end to `report`, and leave."""
    from diffdrive_mpc.models.errors import DiffdriveMpcError

    heard: list[int] = []

    def interrupt(number: int, _: FrameType | None) -> None:
        heard.append(number)
        raise KeyboardInterrupt

    # JAX and Hypothesis call Python at each garbage collection; an exception raised there is lost.
    gc.callbacks.clear()
    gc.freeze()  # the objects of the parent are not part of the reading
    signal.signal(signal.SIGINT, interrupt)
    resource.setrlimit(resource.RLIMIT_AS, (6_000_000_000, 6_000_000_000))
    os.environ["TMPDIR"] = os.environ["SQLITE_TMPDIR"] = tempfile.tempdir = str(scratch)
    os.chdir(scratch)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    try:
        try:
            read(path)
            end = "read"
        except (DiffdriveMpcError, ValueError) as error:
            end = f"refused: {error}"
        # A signal that comes after the end is not the reader's.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        end = f"Ctrl-C was swallowed: {end}" if heard else end
    except KeyboardInterrupt:
        end = "interrupted"
    except BaseException as error:
        end = f"{'Ctrl-C became ' if heard else ''}{type(error).__name__}: {error}"
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
