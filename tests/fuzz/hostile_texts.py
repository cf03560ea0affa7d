"""Makers of hostile texts and tables: YAML, JSON and CSV files, and paths that lead to no file."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import yaml

Maker = Callable[[Random, Path], Path]
Content = Callable[[Random], Any]
"""Text or bytes."""

_MAPPING = "columns: {time: t, command: {v: v, omega: w}, encoders: {v: v2, omega: w2}}\n"
_HEAD = "t,v,w,v2,w2\n"


def odd_name(random: Random) -> str:
    """Return a name with characters that steer a terminal."""
    return "".join(random.sample("\x1b[2J\x07\r\n\x9b31m\u202e\u2028", 4)) + random.choice(("x", "v", "command"))


def special(path: Path, random: Random) -> Path:
    """Put something at the path that is no file on a disk, or leads nowhere."""
    kind = random.choice(("pipe", "/dev/zero", "/dev/random", "/dev/tty", "folder", path.name, "nowhere", "socket", ""))
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(os.path.relpath(path))
    elif kind:
        path.symlink_to(kind)
    return path


def written(name: str, make: Content, random: Random, folder: Path, mapping: str = "") -> Path:
    """Write content under a name, with a mapping next to it."""
    content, path = make(random), folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
    if mapping:
        (folder / "mapping.yaml").write_text(mapping, encoding="utf-8")
    return path


def no_file(name: str, random: Random, folder: Path) -> Path:
    """Put something else in the place of the file."""
    return special(folder / name, random)


def hole(name: str, head: bytes, random: Random, folder: Path) -> Path:
    """Write a gigabyte that takes no room on the disk, behind the first bytes of a sound file."""
    path = written(name, lambda _: head, random, folder)
    os.truncate(path, 1_000_000_000)
    return path


def _digits(random: Random) -> str:
    count = random.choice((5_000, 100_000, 4_000_000))
    return "a: " + random.choice(("9" * count, "0x" + "f" * count, "1:" * count + "1", "." + "1" * count))


def _aliases(random: Random) -> str:
    fan = random.choice((2, 10, 100))
    return "\n".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}' if i else '0'] * fan)}]" for i in range(40))


_YAML: dict[str, Content] = {
    "nesting": lambda random: random.choice(("[", "{a: ", "- ", "? ")) * random.choice((70, 5_000, 1_000_000)),
    "aliases": _aliases,
    "number": _digits,
    "keys": lambda random: "".join(f"key{i}: {i}\n" for i in range(random.choice((90_000, 400_000)))),
    "unknown keys": lambda random: f"weights: {{{', '.join(f'weight{i}: 1' for i in range(40_000))}}}",
    "wrong values": lambda random: f"segments: [{'{v: a, omega: b},' * random.choice((100, 39_000))}]",
    "long text": lambda random: f"name: {'x' * random.choice((100_000, 9_000_000, 20_000_000))}",
    "tag": lambda random: random.choice(("!!python/object/apply:os.system [x]", "a: !!binary A" + "A" * 9_000_000)),
}
_JSON: dict[str, Content] = {
    "nesting": lambda random: random.choice(("[", '{"a":')) * random.choice((1_000, 100_000, 5_000_000)),
    "odd": lambda random: json.dumps({"format": odd_name(random), odd_name(random): 1}),
}


def _rows(count: int, row: Callable[[int], str]) -> str:
    return _HEAD + "".join(f"{row(k)}\n" for k in range(count))


def _steps(random: Random) -> str:
    """Return rows whose times go to and fro, stand still, or leap."""
    pace = random.choice((lambda k: k % 2, lambda k: -k, lambda k: 0, lambda k: k - 3 * (k % 2), lambda k: k * 10**12))
    return _rows(120_000, lambda k: f"{pace(k)},{k % 7},1,{k % 5},2")


_CSV: dict[str, Content] = {
    "times": _steps,
    "long line": lambda random: "a" * 30_000_000,
    "columns": lambda random: ",".join(f"c{i}" for i in range(1_000_000)) + "\n",
    "NUL": lambda random: _HEAD.encode() + bytes(20_000_000),
    "quote": lambda random: _HEAD + '"' + "1,2\n" * 5_000_000,
    "odd": lambda random: f"{odd_name(random)},v,w\n1,{odd_name(random)!r},3\n3,\x1b[2J,3\n",
}
_POSES: dict[str, Content] = {
    "same times": lambda random: "t,x,y,theta\n" + "1,2,3,4\n" * 500_000,
    "columns": lambda random: "t,x,y,theta" + ",c" * 2_000_000 + "\n",
    "line": lambda random: "t,x,y,theta\n" + random.choice(("1", "\0", '"1,\n')) * 30_000_000,
    "many": lambda random: "t,x,y,theta\n" + "".join(f"{k},0,0,0\n" for k in range(200_000)),
}


def _changed(door: str, random: Random) -> str:
    """Change one value of a shipped file."""
    from fuzz import mutation
    from fuzz.yaml_files import seeds

    tree: Any = yaml.safe_load(random.choice(list(seeds(door).values())))
    holder, key = random.choice(list(mutation._places(tree)))
    values: tuple[object, ...] = ([0.5] * 150_000, [[]] * 90_000, "x" * 1_000_000, 10**4000, 1e308, "/dev/zero")
    holder[key] = random.choice((*values, [odd_name(random)] * 1_000, {f"k{i}": i for i in range(30_000)}))
    return str(yaml.safe_dump(tree))


_DOORS = ("controller", "model", "trajectory", "mapping", "stated-robot", "scenario", "experiment")
_BEGINNINGS = {"bag.db3": b"SQLite format 3\0", "bag.mcap": b"\x89MCAP0\r\n", "bag.bag": b"#ROSBAG V2.0\n"}
TEXTS: dict[str, Maker] = {
    **{
        f"{_DOORS[(i + k) % len(_DOORS)]}: YAML {name}": partial(written, "file.yaml", make)
        for i, (name, make) in enumerate(_YAML.items())
        for k in (0, 3)
    },
    **{f"{door}: no file": partial(no_file, "file.yaml") for door in _DOORS},
    **{f"{door}: one value": partial(written, "file.yaml", partial(_changed, door)) for door in _DOORS},
    **{f"report: JSON {name}": partial(written, "contents/.contents.json", make) for name, make in _JSON.items()},
    **{f"ticks: JSON {name}": partial(written, "line.json", make) for name, make in _JSON.items()},
    **{f"log: CSV {name}": partial(written, "log.csv", make, mapping=_MAPPING) for name, make in _CSV.items()},
    **{f"trajectory: CSV {name}": partial(written, "path.csv", make) for name, make in _POSES.items()},
    "log: CSV hole": partial(hole, "log.csv", _HEAD.encode()),
    **{f"log: no file {name}": partial(no_file, name) for name in ("log.csv", *_BEGINNINGS)},
    **{f"log: hole {name}": partial(hole, name, head) for name, head in _BEGINNINGS.items()},
}
