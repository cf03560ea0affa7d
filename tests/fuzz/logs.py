"""Fuzzers of logs and replay: logs with changed bytes, cells, rows and messages are read or rejected in one line."""

from __future__ import annotations

import atexit
import shutil
import sqlite3
import tempfile
from functools import cache
from pathlib import Path
from random import Random

import numpy as np

from diffdrive_mpc.models.logs.reading import read_log
from diffdrive_mpc.mpc import load_config
from fuzz import mutation
from fuzz.case import Case, FaultError
from fuzz.promises import refused_or

BASES = ("own.csv", "own.mcap", "mapped.csv", "bag.db3", "bag.mcap", "metadata.yaml")


class LogFuzzer:
    """Fuzzer of CSV files, drive logs and bags."""

    name, time_limit, count = "logs", 60.0, 200

    def draw(self, random: Random) -> Case:
        """Draw a file and its changes."""
        edits = [mutation.draw_bytes_edit(random) for _ in range(random.choice((1, 1, 2, 5, 20)))]
        return {"base": random.choice(BASES), "edits": edits, "messages": draw_messages(random)}

    def check(self, case: Case) -> None:
        """Read the changed file."""
        with tempfile.TemporaryDirectory() as folder:
            path, mapping = write_changed_log(case, Path(folder))
            log = refused_or(lambda: read_log(path, mapping))
            if log is not None:
                for record in log.records:
                    if not np.isfinite(record.command).all():
                        raise FaultError("log: a command of a record is not finite")


class ReplayFuzzer:
    """Fuzzer of `log replay` with the files of `LogFuzzer`."""

    name, time_limit, count = "replay", 60.0, 80

    draw = LogFuzzer.draw

    def check(self, case: Case) -> None:
        """Read the ticks; replay them if the file has a single change."""
        # Imported here, because this package may be missing in tests of other packages.
        from diffdrive_mpc_extras.replay.node_log import LoggedConfigs
        from diffdrive_mpc_extras.replay.own_log import read_recording
        from diffdrive_mpc_extras.replay.replay import replay

        with tempfile.TemporaryDirectory() as folder:
            path, _ = write_changed_log(case, Path(folder))
            scratch = Path(folder, "scratch")
            scratch.mkdir()
            recording = refused_or(lambda: read_recording(path, LoggedConfigs(path, scratch)))
            if recording is not None and len(case["edits"]) == 1:
                config = recording.config or load_config("ssm")
                references = recording.references
                if len(references) == len(recording.starts):
                    refused_or(lambda: replay(recording, config, references, as_recorded=True))


def draw_messages(random: Random) -> list[list[object]]:
    """Draw changes of messages of a bag: index as a share of the count, and change of the bytes."""
    if random.random() < 0.5:
        return []
    return [[random.random(), mutation.draw_bytes_edit(random)] for _ in range(random.choice((1, 3, 10)))]


def write_changed_log(case: Case, folder: Path) -> tuple[Path, Path | None]:
    """Write the log of a case to `folder`; return the paths of log and mapping."""
    base, originals = case["base"], base_files()
    mapping = originals / "mapping.yaml" if base == "mapped.csv" else None
    if base in ("bag.db3", "metadata.yaml", "bag.mcap"):
        bag = folder / "bag"
        shutil.copytree(originals / ("mcap_bag" if base == "bag.mcap" else "bag"), bag)
        target = next(bag.glob("*.mcap" if base == "bag.mcap" else "*.db3" if base == "bag.db3" else "metadata.yaml"))
        if base == "bag.db3" and case["messages"]:
            _change_rows(target, case["messages"])
        else:
            target.write_bytes(mutation.edited_bytes(target.read_bytes(), case["edits"]))
        return bag, None
    path = folder / base
    path.write_bytes(mutation.edited_bytes((originals / base).read_bytes(), case["edits"]))
    return path, mapping


def _change_rows(file: Path, changes: list[list[object]]) -> None:
    """Change bytes and stamps of messages in the database."""
    with sqlite3.connect(file) as database:
        rows = database.execute("select id, timestamp, data from messages").fetchall()
        for share, edit in changes:
            number, stamp, data = rows[int(share * len(rows))]  # type: ignore[operator]
            kind = edit[0]  # type: ignore[index]
            if kind == "cell":
                database.execute("update messages set timestamp = ? where id = ?", (edit[2], number))  # type: ignore[index]
            elif kind == "length":
                database.execute(
                    "update messages set timestamp = ? where id = ?", (stamp + 10**9 * (edit[2] - 2**31), number)
                )  # type: ignore[index]
            else:
                database.execute(
                    "update messages set data = ? where id = ?",
                    (mutation.edited_bytes(data, [edit]), number),  # type: ignore[list-item]
                )


@cache
def base_files() -> Path:
    """Return a folder with logs of all kinds, written once per process."""
    from log_parts import MAPPING, bag_topics, drive, write_bag, write_csv

    folder = Path(tempfile.mkdtemp(prefix="fuzz-logs-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    columns = drive(seconds=12.0)
    write_csv(folder / "mapped.csv", columns)
    (folder / "mapping.yaml").write_text(MAPPING)
    write_bag(folder / "bag", bag_topics(columns))
    write_bag(folder / "mcap_bag", bag_topics(columns), "mcap")
    _write_drive_logs(folder)
    return folder


def _write_drive_logs(folder: Path) -> None:
    """Write logs of `simulate --log` as CSV and as MCAP."""
    from commands import invoke
    from diffdrive_mpc.app.cli import app

    (folder / "short.yaml").write_text(
        "segments: [{v: 0.4, omega: 0.3, duration: 2.0}, {v: 0.3, omega: -0.6, duration: 2.0}]\n"
    )
    arguments = ["simulate", "--trajectory", folder / "short.yaml", "--plant", "model:ssm"]
    for name in ("own.csv", "own.mcap"):
        invoke(app, *arguments, "--log", folder / name)
