"""The data base of a ROS 2 bag: real tables only, read row by row without their indices.

The author of a file controls its schema and its pages: a view may compute rows without end, and pages may name each
other again and again. So only tables are read, their rows must come in the order of their numbers, and steps that give
no row are counted.
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
from diffdrive_mpc.models.logs.bag_bounds import MOST_UNPACKED, Budget

SQLITE_MAGIC = b"SQLite format 3\0"
_SAFE = "PRAGMA trusted_schema = OFF; PRAGMA temp_store = MEMORY; PRAGMA mmap_size = 0; PRAGMA cell_size_check = ON"
_LIMITS = {
    sqlite3.SQLITE_LIMIT_LENGTH: MOST_UNPACKED,
    sqlite3.SQLITE_LIMIT_SQL_LENGTH: MEGABYTE,
    sqlite3.SQLITE_LIMIT_COLUMN: 100,
    sqlite3.SQLITE_LIMIT_EXPR_DEPTH: 50,
}
_TABLES = ("messages", "topics")
_PLAIN = re.compile(r"CREATE (TABLE|INDEX|UNIQUE INDEX|TRIGGER) ", re.IGNORECASE)
_STEPS = 10_000
"""Steps of SQLite's machine between two looks at them."""
_ROW = "rowid, topic_id, timestamp, typeof(topic_id), typeof(timestamp), typeof(data), length(data)"
_TYPES = ("integer", "integer", "blob")


class _Watch:
    """Ends a statement that makes steps and gives no row; between them Ctrl-C is heard."""

    def __init__(self) -> None:
        self.looks = 0
        self.is_over = False

    def look(self) -> bool:
        """Return True to end the statement."""
        self.looks += 1
        self.is_over = self.looks > file_limits().sqlite_steps // _STEPS
        return self.is_over


def sqlite_messages(
    path: Path, topics: Collection[tuple[str, str]] = ()
) -> Iterator[tuple[str, str, int | None, bytes]]:
    """Yield topic, type, time of receipt [ns] and bytes of the messages; of a topic itself once, without a time.

    Parameters
    ----------
    path
        The file.
    topics
        Topic and type of those messages whose bytes are read; those of other topics are left empty.

    Raises
    ------
    models.checked_yaml.ConfigError
        If its tables are not those of a bag, or hold more than is read.
    ValueError
        If it is damaged.
    OSError
        If the file cannot be opened.
    """
    watch = _Watch()
    try:
        with _opened(path) as (base, size):
            base.set_progress_handler(watch.look, _STEPS)
            yield from _rows(path, base, Budget(path, size), watch, topics)
    except sqlite3.Error as error:
        if watch.is_over:
            raise ConfigError(
                f"{path}: its tables take SQLite too long; export it again (`ros2 bag convert`)"
            ) from error
        if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_INTERRUPT:
            # Ctrl-C occurred while SQLite called `look`, which cannot pass exceptions.
            raise KeyboardInterrupt from error
        raise ValueError(str(error)) from error


@contextmanager
def _opened(path: Path) -> Iterator[tuple[sqlite3.Connection, int]]:
    """Open the data base, which nothing can change; yield it and the size of its file."""
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        base = sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)
        try:
            for limit, most in _LIMITS.items():
                base.setlimit(limit, most)
            base.executescript(_SAFE)
            yield base, size
        finally:
            base.close()


def _rows(
    path: Path, base: sqlite3.Connection, budget: Budget, watch: _Watch, topics: Collection[tuple[str, str]]
) -> Iterator[tuple[str, str, int | None, bytes]]:
    # Names and kinds in the schema may be forged; SQLite goes by the statements, and takes long to prepare views.
    foreign = any(sql and not _PLAIN.match(str(sql)) for (sql,) in base.execute("SELECT sql FROM sqlite_master"))
    # Columns that are worked out take no room in the file, and any in memory.
    if foreign or any(row[6] for table in _TABLES for row in base.execute(f"PRAGMA table_xinfo({table})")):
        raise ConfigError(f"{path}: it holds views or made columns, not the tables of a bag; export it again")
    known: dict[int, tuple[str, str]] = {}
    for number, row in _increasing(base, "rowid, id, name, type, serialization_format FROM topics", watch):
        if number >= file_limits().bag_topics:
            raise ConfigError(f"{path}: more than {file_limits().bag_topics:,} topics; is it a bag?")
        budget.take(sum(len(text) for text in row[1:] if isinstance(text, (str, bytes))))
        if row[3] == "cdr" and isinstance(row[0], int) and isinstance(row[1], str) and isinstance(row[2], str):
            known[row[0]] = row[1], row[2]
            yield *known[row[0]], None, b""
    numbers = ",".join(str(number) for number, topic in known.items() if topic in topics)
    wrong = 0
    for _, row in _increasing(base, f"{_ROW}, CASE WHEN topic_id IN ({numbers}) THEN data END FROM messages", watch):
        topic, time, *kinds, length, data = row
        budget.take(length if isinstance(length, int) else 0)
        if tuple(kinds) != _TYPES:
            wrong += 1
        elif topic in known:
            yield *known[topic], time, data or b""
    if wrong:
        raise ConfigError(
            f"{path}: {wrong} messages have a stamp that is no whole number of nanoseconds, or hold no bytes; "
            "export the bag again (`ros2 bag convert`)"
        )


def _increasing(base: sqlite3.Connection, columns: str, watch: _Watch) -> Iterator[tuple[int, tuple[Any, ...]]]:
    """Yield the number of each row from 0, and the columns after its `rowid`; pages that come again are damage."""
    before = None
    for number, (rowid, *row) in enumerate(base.execute(f"SELECT {columns} NOT INDEXED")):
        if not isinstance(rowid, int) or (before is not None and rowid <= before):
            raise ValueError("its rows are out of order")
        before, watch.looks = rowid, 0
        yield number, tuple(row)
