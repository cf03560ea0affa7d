"""Reader of the SQLite database of a ROS 2 bag: tables only, row by row and without indices.

An untrusted file controls its schema and pages: a view may compute endless rows, and pages may form loops. Therefore
only tables are read, their row ids must increase, and the number of steps between two rows is limited.
"""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.input_file import MEGABYTE, open_input
from diffdrive_mpc.models.logs.bag_bounds import MAX_UNPACKED, Budget

SQLITE_MAGIC = b"SQLite format 3\0"
_SAFE_PRAGMAS = (
    "PRAGMA trusted_schema = OFF; PRAGMA temp_store = MEMORY; PRAGMA mmap_size = 0; PRAGMA cell_size_check = ON"
)
_LIMITS = {
    sqlite3.SQLITE_LIMIT_LENGTH: MAX_UNPACKED,
    sqlite3.SQLITE_LIMIT_SQL_LENGTH: MEGABYTE,
    sqlite3.SQLITE_LIMIT_COLUMN: 100,
    sqlite3.SQLITE_LIMIT_EXPR_DEPTH: 50,
}
_TABLES = ("messages", "topics")
_ALLOWED_STATEMENT = re.compile(r"CREATE (TABLE|INDEX|UNIQUE INDEX|TRIGGER) ", re.IGNORECASE)
_STEPS = 10_000
"""Number of instructions of SQLite's virtual machine between two calls of the progress handler."""
_ROW = "rowid, topic_id, timestamp, typeof(topic_id), typeof(timestamp), typeof(data), length(data)"
_TYPES = ("integer", "integer", "blob")


class _Watchdog:
    """Progress handler that ends a statement after too many steps without a row; it also lets Ctrl-C interrupt it."""

    def __init__(self) -> None:
        self.calls = 0
        self.has_expired = False

    def check(self) -> bool:
        """Count a call; return True to end the statement."""
        self.calls += 1
        self.has_expired = self.calls > file_limits().sqlite_steps // _STEPS
        return self.has_expired


def sqlite_messages(
    path: Path, topics: Collection[tuple[str, str]] = ()
) -> Iterator[tuple[str, str, int | None, bytes]]:
    """Yield topic, type, time of receipt [ns] and bytes of the messages; each topic is first yielded without a time.

    Parameters
    ----------
    path
        The file.
    topics
        Topics and types whose bytes are read; the bytes of other messages are empty.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the tables are not those of a bag or exceed a limit.
    ValueError
        If the file is damaged.
    OSError
        If the file cannot be opened.
    """
    watchdog = _Watchdog()
    try:
        with _open_database(path) as (database, size):
            database.set_progress_handler(watchdog.check, _STEPS)
            yield from _rows(path, database, Budget(path, size), watchdog, topics)
    except sqlite3.Error as error:
        if watchdog.has_expired:
            raise ConfigError(
                f"{path}: reading its tables takes too long; export it again (`ros2 bag convert`)"
            ) from error
        if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_INTERRUPT:
            # Ctrl-C occurred inside `check`; SQLite does not propagate its exceptions.
            raise KeyboardInterrupt from error
        raise ValueError(str(error)) from error


@contextmanager
def _open_database(path: Path) -> Iterator[tuple[sqlite3.Connection, int]]:
    """Open the database read-only; yield it and the size of its file [bytes]."""
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        # `immutable` also ignores journals next to the file, which could change its content.
        database = sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)
        try:
            for category, limit in _LIMITS.items():
                database.setlimit(category, limit)
            database.executescript(_SAFE_PRAGMAS)
            yield database, size
        finally:
            database.close()


def _rows(
    path: Path, database: sqlite3.Connection, budget: Budget, watchdog: _Watchdog, topics: Collection[tuple[str, str]]
) -> Iterator[tuple[str, str, int | None, bytes]]:
    # Check the statements, because names and types in the schema may be forged. Preparing a view may take long.
    has_other_statements = any(
        sql and not _ALLOWED_STATEMENT.match(str(sql)) for (sql,) in database.execute("SELECT sql FROM sqlite_master")
    )
    # Generated columns take no space in the file but unlimited memory.
    if has_other_statements or any(
        row[6] for table in _TABLES for row in database.execute(f"PRAGMA table_xinfo({table})")
    ):
        raise ConfigError(
            f"{path}: it contains views or generated columns, not only the tables of a bag; export it again"
        )
    known: dict[int, tuple[str, str]] = {}
    for number, row in _ordered_rows(database, "rowid, id, name, type, serialization_format FROM topics", watchdog):
        if number >= file_limits().bag_topics:
            raise ConfigError(f"{path}: more than {file_limits().bag_topics:,} topics; is it a bag?")
        budget.take(sum(len(text) for text in row[1:] if isinstance(text, (str, bytes))))
        if row[3] == "cdr" and isinstance(row[0], int) and isinstance(row[1], str) and isinstance(row[2], str):
            known[row[0]] = row[1], row[2]
            yield *known[row[0]], None, b""
    # Bytes of other topics are not read from disk. The numbers are integers, so the statement is safe.
    numbers = ",".join(str(number) for number, topic in known.items() if topic in topics)
    invalid_count = 0
    for _, row in _ordered_rows(
        database, f"{_ROW}, CASE WHEN topic_id IN ({numbers}) THEN data END FROM messages", watchdog
    ):
        topic, time, *kinds, length, data = row
        budget.take(length if isinstance(length, int) else 0)
        if tuple(kinds) != _TYPES:
            invalid_count += 1
        elif topic in known:
            yield *known[topic], time, data or b""
    if invalid_count:
        raise ConfigError(
            f"{path}: {invalid_count} messages have a stamp that is not an integer [ns], or data that are not bytes; "
            "export the bag again (`ros2 bag convert`)"
        )


def _ordered_rows(
    database: sqlite3.Connection, columns: str, watchdog: _Watchdog
) -> Iterator[tuple[int, tuple[Any, ...]]]:
    """Yield the index of each row from 0 and the columns after `rowid`; raise ValueError if row ids do not increase."""
    last_id = None
    for number, (rowid, *row) in enumerate(database.execute(f"SELECT {columns} NOT INDEXED")):
        if not isinstance(rowid, int) or (last_id is not None and rowid <= last_id):
            raise ValueError("its rows are out of order")
        last_id, watchdog.calls = rowid, 0
        yield number, tuple(row)
