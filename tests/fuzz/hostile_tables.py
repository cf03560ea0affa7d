"""Makers of hostile CSV and Parquet logs."""

from __future__ import annotations

import codecs
import io
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random

import numpy as np

from fuzz.hostile_texts import odd_name, special

_MAPPING = "columns: {time: t, command: {v: v, omega: w}, encoders: {v: v2, omega: w2}}\n"
_HEAD = "t,v,w,v2,w2\n"


def _rows(count: int, time: Callable[[int], object], cell: Callable[[int], object] = lambda k: 0.1) -> str:
    return _HEAD + "".join(f"{time(k)},{cell(k)},{cell(k + 1)},{cell(k)},{cell(k + 2)}\n" for k in range(count))


def _steps(random: Random) -> str:
    """Return rows whose times go to and fro, stand still, or leap."""
    pace = random.choice(
        (lambda k: k % 2, lambda k: -k, lambda k: 0, lambda k: k * 10 ** random.choice((6, 12)), lambda k: k * 1e-9)
    )
    return _rows(100_000, pace, lambda k: k % 7)


_TEXTS: dict[str, Callable[[Random], str | bytes]] = {
    "times": _steps,
    "times to and fro": lambda random: _rows(150_000, lambda k: k - 3 * (k % 2), lambda k: k % 5),
    "long line": lambda random: "a" * 30_000_000,
    "columns": lambda random: ",".join(f"c{i}" for i in range(1_000_000)) + "\n",
    "columns of a row": lambda random: _HEAD + "1," * random.choice((400_000, 5_000_000)),
    "zeros": lambda random: _HEAD.encode() + bytes(20_000_000),
    "words": lambda random: _rows(150_000, lambda k: f"t{k}", lambda k: f"w{k}"),
    "quote": lambda random: _HEAD + '"' + "1,2\n" * 5_000_000,
    "quotes": lambda random: _HEAD + '"1","2","3","4","5"\n' * 300_000,
    "one name": lambda random: "t," * 5_000 + "\n" + "1," * 5_000,
    "lines": lambda random: _HEAD + "\n" * 20_000_000,
    "returns": lambda random: _HEAD + "\r" * 5_000_000,
    "odd names": lambda random: f"{odd_name(random)},{odd_name(random)},v,w\n1,2,3,4\n",
    "odd cells": lambda random: _HEAD + f"1,2,3,4,5\n2,{odd_name(random)!r},3,4,5\n3,\x1b[2J,3,4,5\n",
    "numbers": lambda random: _rows(
        3_000, lambda k: random.choice(("nan", "inf", "1e308", "-1e308", "0x10", k)), lambda k: "9" * 400
    ),
    "utf-16": lambda random: codecs.BOM_UTF16_LE + b"\0\xd8" * 100_000,
    "bytes": lambda random: bytes(random.randrange(256) for _ in range(10_000)),
    "long cell": lambda random: _HEAD + "1," + "2" * 900_000 + ",3,4,5\n",
    "empty": lambda random: random.choice(("", "\n", _HEAD, "\ufeff")),
    "separators": lambda random: random.choice(",;\t") * 9_000 + "\n" + "," * 900_000,
}


def _csv(make: Callable[[Random], str | bytes], random: Random, folder: Path) -> Path:
    content = make(random)
    path = folder / "log.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
    (folder / "mapping.yaml").write_text(_MAPPING)
    return path


def _own(make: Callable[[Random], str | bytes], random: Random, folder: Path) -> Path:
    """Write a log with the columns of `simulate --log`."""
    from fuzz.logs import base_files

    head, row = (base_files() / "own.csv").read_bytes().splitlines()[:2]
    content = make(random)
    content = content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass")
    path = folder / "log.csv"
    path.write_bytes(head + b"\n" + random.choice((b"", row + b"\n")) + content.partition(b"\n")[2])
    return path


def _many_rows(random: Random, folder: Path) -> Path:
    from fuzz.logs import base_files

    head, row = (base_files() / "own.csv").read_bytes().splitlines()[:2]
    path = folder / "log.csv"
    path.write_bytes(head + b"\n" + (row + b"\n") * random.choice((5_000, 400_000)))
    return path


def _hole(random: Random, folder: Path) -> Path:
    """Write a gigabyte that takes no room on the disk."""
    path = folder / "log.csv"
    with path.open("wb") as file:
        file.write(random.choice((b"", _HEAD.encode())))
        file.truncate(1_000_000_000)
    return path


def _poses(random: Random, folder: Path) -> Path:
    """Write timed poses."""
    path = folder / "path.csv"
    path.write_bytes(
        random.choice(
            (
                b"t,x,y,theta\n" + b"1,2,3,4\n" * 500_000,
                b"t,x,y,theta" + b",c" * 2_000_000 + b"\n",
                b"t,x,y,theta\n" + b"1" * 50_000_000,
                b"t,x,y,theta\n" + bytes(30_000_000),
                b't,x,y,theta\n"' + b"1,\n" * 10_000_000,
                b"t,x,y,theta\n" + b"".join(b"%d,0,0,0\n" % k for k in range(200_000)),
                b"\x1b[2J,x,y,theta\n",
            )
        )
    )
    return path


def _parquet(random: Random, folder: Path) -> Path:
    import pyarrow
    from pyarrow import parquet

    (folder / "mapping.yaml").write_text(_MAPPING)
    path = folder / "log.parquet"
    names = ("t", "v", "w", "v2", "w2")
    kind = random.choice(("bomb", "columns", "nested", "words", "lying", "cut", "odd"))
    if kind == "columns":
        parquet.write_table(pyarrow.table({f"c{i}": [1] for i in range(5_000)}), path)
    elif kind == "nested":
        parquet.write_table(pyarrow.table({name: [[[1.0]] * 1_000] * 100 for name in names}), path)
    elif kind == "words":
        parquet.write_table(pyarrow.table({name: [f"{name}{k}" for k in range(200_000)] for name in names}), path)
    elif kind == "odd":
        parquet.write_table(pyarrow.table({odd_name(random): [1.0], "v": ["\x1b[2J"]}), path)
    else:
        count = 20_000_000 if kind == "bomb" else 20_000
        table = pyarrow.table({name: np.zeros(count) for name in names[:2]})
        parquet.write_table(table, path, compression="zstd", use_dictionary=False)
        content = bytearray(path.read_bytes())
        if kind == "lying":
            for _ in range(random.choice((1, 5, 50))):
                content[random.randrange(4, len(content) - 8)] = random.randrange(256)
        elif kind == "cut":
            content[-8:-4] = struct.pack("<I", random.choice((0, 2**31, 2**32 - 1, len(content))))
        path.write_bytes(content)
    return path


def _lying_parquet(random: Random, folder: Path) -> Path:
    """Write pages that unpack to a gigabyte, and a directory that states a small size."""
    import pyarrow
    from pyarrow import parquet

    (folder / "mapping.yaml").write_text("columns: {time: t, command: {v: t, omega: t}, encoders: {v: t, omega: t}}")
    path = folder / "log.parquet"
    whole = io.BytesIO()
    count = 60_000_000  # more would be several groups of rows
    table = pyarrow.table({"t": np.zeros(count, np.float64)})
    parquet.write_table(
        table,
        whole,
        compression="zstd",
        use_dictionary=False,
        data_page_size=2**30,
        row_group_size=count,
        write_statistics=False,
    )
    content = whole.getvalue()
    size = parquet.ParquetFile(whole).metadata.row_group(0).column(0).total_uncompressed_size
    start = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    directory = content[start:]
    for number, small in ((size, 1_000), (count, 1_000)):
        directory = directory.replace(_varint(number), _varint(small, len(_varint(number))))
    content = content[:start] + directory
    path.write_bytes(content)
    return path


def _varint(number: int, length: int = 0) -> bytes:
    number, out = number << 1, bytearray()
    while number > 0x7F or len(out) + 1 < length:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*out, number])


def _special(random: Random, folder: Path) -> Path:
    return special(folder / random.choice(("log.csv", "log.parquet")), random)


TABLES: dict[str, Callable[[Random, Path], Path]] = {
    **{f"log: CSV {name}": partial(_csv, make) for name, make in _TEXTS.items()},
    **{f"replay: CSV {name}": partial(_own, make) for name, make in _TEXTS.items()},
    "replay: CSV rows": _many_rows,
    "log: CSV hole": _hole,
    "replay: CSV hole": _hole,
    "trajectory: CSV": _poses,
    "trajectory: CSV again": _poses,
    "log: Parquet": _parquet,
    "log: Parquet again": _parquet,
    "log: Parquet lying": _lying_parquet,
    "log: no file": _special,
    "replay: no file": _special,
}
