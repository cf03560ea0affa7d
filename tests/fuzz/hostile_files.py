"""Hostile files of all kinds: each is read, or refused with one line, within bounds of time, memory and space.

`python -m fuzz.hostile_files --count 300 --seed 1` prints the figures; it leaves with 1 if a file breaks a bound.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random

from fuzz.hostile_bags import BAGS
from fuzz.hostile_tables import TABLES
from fuzz.hostile_texts import TEXTS

SECONDS, MEMORY, TEMPORARY, INTERRUPTED = 5.0, 1000.0, 64.0, 2.0
"""Bounds: processor time [s], peak memory [MB], temporary space [MB], time from Ctrl-C to the end [s]."""
_HANGS = 60.0
"""Time after which a reader is killed [s]."""
_SLOW = 1.0
"""Readers that take longer are interrupted in a second run [s]."""
_ESCAPES = 200

Maker = Callable[[Random, Path], Path]
MAKERS: dict[str, Maker] = {**BAGS, **TABLES, **TEXTS}
"""By name `door: kind of attack`; each writes a file and returns its path."""


def doors() -> dict[str, Callable[[Path], object]]:
    """Return the readers by the name of their door."""
    from diffdrive_mpc import load_config, load_model, load_trajectory
    from diffdrive_mpc.app.replay.node_log import LoggedConfigs
    from diffdrive_mpc.app.replay.own_log import read_recording
    from diffdrive_mpc.app.tune.tune_file import load_plan
    from diffdrive_mpc.bench.report_folder import staged
    from diffdrive_mpc.bench.spec import load_experiment
    from diffdrive_mpc.models.logs.mapping import load_mapping
    from diffdrive_mpc.models.logs.reading import read_log
    from diffdrive_mpc.models.logs.tick_record import DriveRecord
    from diffdrive_mpc.models.stated_robot import load_stated_robot
    from diffdrive_mpc.sim.disturbances.scenario import load_scenario

    def log(path: Path) -> object:
        mapping = path.with_name("mapping.yaml")
        return read_log(path, mapping if mapping.is_file() else None)

    def replay(path: Path) -> object:
        with tempfile.TemporaryDirectory() as scratch:
            return read_recording(path, LoggedConfigs(path, Path(scratch)))

    def report(path: Path) -> None:
        with staged(path, ["report.html"], owner="bench") as folder:
            (folder / "report.html").write_text("new", encoding="utf-8")

    return {
        "log": log,
        "replay": replay,
        "report": report,
        "ticks": lambda path: DriveRecord.read(path.read_text(encoding="utf-8")),
        "controller": load_config,
        "model": load_model,
        "trajectory": load_trajectory,
        "mapping": load_mapping,
        "stated-robot": load_stated_robot,
        "scenario": load_scenario,
        "experiment": load_experiment,
        "tune": load_plan,
    }


@dataclass(frozen=True)
class Outcome:
    """Result of one file."""

    name: str
    index: int
    end: str
    seconds: float
    wall: float
    memory: float
    temporary: float
    interrupted: float | None = None

    def faults(self) -> list[str]:
        """Return the broken bounds."""
        faults = [] if self.end.startswith(("read", "refused: ")) else [self.end]
        line = self.end.removeprefix("refused: ")
        if self.end.startswith("refused: ") and (not line.isprintable() or not 0 < len(line) <= 4000):
            faults.append(f"its line cannot be shown: {line[:_ESCAPES]!r}")
        for value, most, name in (
            (self.seconds, SECONDS, "s of processor time"),
            (self.memory, MEMORY, "MB of memory"),
            (self.temporary, TEMPORARY, "MB of temporary space"),
            (self.interrupted or 0.0, INTERRUPTED, "s from Ctrl-C to its end"),
        ):
            if value > most:
                faults.append(f"{value:.1f} {name}")
        return faults


def run(seed: int, count: int, say: Callable[[Outcome], None] = lambda _: None) -> list[Outcome]:
    """Make and read files; every maker comes before one comes again."""
    readers, names, outcomes = doors(), list(MAKERS), []
    Random(seed).shuffle(names)
    warnings.simplefilter("ignore")
    for index in range(count):
        name = names[index % len(names)]
        with tempfile.TemporaryDirectory(prefix="hostile-") as folder:
            (home := Path(folder, "made")).mkdir()
            path = MAKERS[name](Random(f"{name}/{seed}/{index}"), home)
            outcome = _read(readers[name.partition(":")[0]], path, Path(folder), name, index)
        outcomes.append(outcome)
        say(outcome)
    return outcomes


def _read(read: Callable[[Path], object], path: Path, folder: Path, name: str, index: int) -> Outcome:
    end, seconds, wall, memory, temporary = _in_child(read, path, folder, None)
    interrupted = None
    if wall > _SLOW and end != "hangs":
        second_end, used, second, _, _ = _in_child(read, path, folder, wall / 2)
        # On a busy machine a process waits for its turn: it did no more after Ctrl-C than in all.
        interrupted = min(second - wall / 2, used) if second_end == "interrupted" else 0.0
    return Outcome(name, index, end, seconds, wall, memory, temporary, interrupted)


def _in_child(
    read: Callable[[Path], object], path: Path, folder: Path, interrupt: float | None
) -> tuple[str, float, float, float, float]:
    """End, processor time [s], time [s], memory [MB] and temporary space [MB] of a reader in a process of its own."""
    (scratch := folder / "scratch").mkdir(exist_ok=True)
    report = folder / "end"
    report.unlink(missing_ok=True)
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        _inside(read, path, scratch, report)
    temporary, sent = 0.0, False
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        wall = time.monotonic() - started
        if done:
            break
        temporary = max(temporary, _space(child, scratch))
        if wall > _HANGS:
            os.kill(child, signal.SIGKILL)
        elif interrupt is not None and not sent and wall > interrupt:
            os.kill(child, signal.SIGINT)
            sent = True
        time.sleep(0.005)
    end = report.read_text(encoding="utf-8", errors="replace") if report.exists() else ""
    if os.WIFSIGNALED(status):
        end = "hangs" if wall > _HANGS else f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
    return end, usage.ru_utime + usage.ru_stime, wall, usage.ru_maxrss / 1e3, temporary


def _inside(read: Callable[[Path], object], path: Path, scratch: Path, report: Path) -> None:
    """Read in the child, write the end to `report`, and leave."""
    from diffdrive_mpc.models.errors import DiffdriveMpcError

    signal.signal(signal.SIGINT, signal.default_int_handler)
    resource.setrlimit(resource.RLIMIT_AS, (6_000_000_000, 6_000_000_000))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.environ["TMPDIR"] = os.environ["SQLITE_TMPDIR"] = tempfile.tempdir = str(scratch)
    os.chdir(scratch)
    with Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        read(path)
        end = "read"
    except KeyboardInterrupt:
        end = "interrupted"
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
        handles = list(Path(f"/proc/{process}/fd").iterdir())
        named = [path for path in scratch.rglob("*") if path.is_file()]
        for path in (*named, *(handle for handle in handles if str(handle.readlink()).startswith(str(scratch)))):
            with suppress(OSError):
                state = path.stat()
                sizes[state.st_dev, state.st_ino] = state.st_size
    return sum(sizes.values()) / 1e6


def main() -> None:
    """Read the words, run, and print figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="makers whose names have this in them")
    words = parser.parse_args()
    if words.only:
        for name in [name for name in MAKERS if words.only not in name]:
            del MAKERS[name]

    def say(outcome: Outcome) -> None:
        faults = "; ".join(outcome.faults())
        figures = f"{outcome.seconds:5.1f} s {outcome.memory:5.0f} MB {outcome.temporary:3.0f} MB"
        stopped = "" if outcome.interrupted is None else f" Ctrl-C {outcome.interrupted:.2f} s"
        print(
            f"{figures}{stopped} {outcome.name}: {outcome.end[:150]!r}{'  FAULT ' + faults[:300] if faults else ''}",
            flush=True,
        )

    outcomes = run(words.seed, words.count, say)
    slow = [outcome.interrupted for outcome in outcomes if outcome.interrupted is not None]
    print(
        json.dumps(
            {
                "files": len(outcomes),
                "refused": sum(outcome.end.startswith("refused") for outcome in outcomes),
                "read": sum(outcome.end == "read" for outcome in outcomes),
                "with faults": sum(bool(outcome.faults()) for outcome in outcomes),
                "most processor time [s]": round(max(outcome.seconds for outcome in outcomes), 2),
                "most memory [MB]": round(max(outcome.memory for outcome in outcomes)),
                "most temporary space [MB]": round(max(outcome.temporary for outcome in outcomes), 1),
                "interrupted": len(slow),
                "most time after Ctrl-C [s]": round(max(slow, default=0.0), 2),
            }
        )
    )
    sys.exit(1 if any(outcome.faults() for outcome in outcomes) else 0)


if __name__ == "__main__":
    main()
