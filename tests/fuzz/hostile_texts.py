"""Makers of hostile YAML and JSON files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import yaml

_ODD = "\x1b[2J\x07\r\n\x9b31m\u202e\u2028"
_MANY, _LARGE = 1_000_000, 20_000_000


def odd_name(random: Random) -> str:
    """Return a name with characters that steer a terminal."""
    return "".join(random.sample(_ODD, 4)) + random.choice(("x", "v", "command", "topic"))


def _nested(random: Random) -> str:
    depth = random.choice((70, 5_000, 1_000_000))
    return random.choice(("[" * depth, "{a: " * depth, "- " * depth, "[" * depth + "]" * depth, "? " * depth))


def _aliases(random: Random) -> str:
    fan = random.choice((2, 10, 100))
    lines = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}' if i else '0'] * fan)}]" for i in range(40)]
    return "\n".join(lines)


def _merges(random: Random) -> str:
    lines = [f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 10)}]\n  k{i}: 1" for i in range(1, 30)]
    return "a0: &a0 {k: 1}\n" + "\n".join(lines)


def _number(random: Random) -> str:
    digits = random.choice((5_000, 100_000, 4_000_000))
    return random.choice(("horizon: {}", "name: {}", "a: [{}]")).format(
        random.choice(("9" * digits, "0x" + "f" * digits, "0b" + "1" * digits, "1:" * digits + "1", "." + "1" * digits))
    )


_YAML: dict[str, Callable[[Random], str | bytes]] = {
    "nested": _nested,
    "aliases": _aliases,
    "merges": _merges,
    "number": _number,
    "circle": lambda random: "a: &a [*a]",
    "keys": lambda random: "".join(f"key{i}: {i}\n" for i in range(random.choice((40_000, 400_000)))),
    "unknown keys of groups": lambda random: (
        "weights: {" + ", ".join(f"weight{i}: 1" for i in range(random.choice((5_000, 40_000)))) + "}"
    ),
    "wrong values": lambda random: f"segments: [{', '.join(['{v: a, omega: b}'] * 12_000)}]",
    "values": lambda random: f"a: [{'1,' * _MANY}]",
    "long text": lambda random: f"name: {'x' * random.choice((100_000, _LARGE))}",
    "long key": lambda random: f"{'k' * 100_000}: 1",
    "long line of blanks": lambda random: "a:" + " " * _LARGE + "1",
    "comments": lambda random: "# nothing\n" * random.choice((100_000, 6_000_000)),
    "documents": lambda random: "---\na: 1\n" * 100_000,
    "anchors": lambda random: "".join(f"k{i}: &a{i} 1\n" for i in range(40_000)),
    "odd keys": lambda random: yaml.safe_dump({odd_name(random): 1, "name": odd_name(random)}, allow_unicode=True),
    "odd bytes": lambda random: bytes(random.randrange(256) for _ in range(random.choice((1, 100, 10_000)))),
    "zeros": lambda random: bytes(random.choice((1, 1_000_000))),
    "utf-16": lambda random: "name: a\n".encode("utf-16"),
    "tag": lambda random: random.choice(
        ("!!python/object/apply:os.system [x]", "!!set {a, b}", "a: !!binary A" + "A" * 9_000_000)
    ),
    "timestamp": lambda random: f"a: {random.choice(('2020-13-40', '9999999999-01-01', '2020-01-01T99:99:99Z'))}",
    "quotes": lambda random: '"' + "\\x1b" * 1_000_000,
    "directive": lambda random: "%TAG ! " + "x" * 1_000_000,
}
_JSON: dict[str, Callable[[Random], str]] = {
    "nested": lambda random: random.choice(("[", '{"a":')) * random.choice((1_000, 100_000, 5_000_000)),
    "number": lambda random: '{"a":' + "9" * random.choice((5_000, 4_000_000)) + "}",
    "lists": lambda random: "[" + "[]," * 10_000_000 + "[]]",
    "keys": lambda random: json.dumps({f"k{i}": i for i in range(200_000)}),
    "wrong": lambda random: json.dumps(
        random.choice(([], 1, "x", None, {"a": [1]}, {"report.html": {"by": 1, "bytes": 1e400}}))
    ),
    "odd": lambda random: json.dumps({"format": odd_name(random), odd_name(random): 1}),
}


def special(path: Path, random: Random) -> Path:
    """Put something at the path that is no file on a disk, or leads nowhere."""
    kind = random.choice(("pipe", "device", "folder", "loop", "nothing", "socket", "broken link"))
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to(random.choice(("/dev/zero", "/dev/random", "/dev/stdin", "/dev/tty")))
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "broken link":
        path.symlink_to("nowhere")
    elif kind == "socket":
        import socket

        with socket.socket(socket.AF_UNIX) as made:
            before = Path.cwd()
            os.chdir(path.parent)
            made.bind(path.name)
            os.chdir(before)
    return path


def _yaml(make: Callable[[Random], str | bytes], random: Random, folder: Path) -> Path:
    content = make(random)
    path = folder / "file.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
    return path


def _special(random: Random, folder: Path) -> Path:
    return special(folder / "file.yaml", random)


def _changed(door: str, random: Random, folder: Path) -> Path:
    """Change one value of a shipped file."""
    from fuzz import mutation
    from fuzz.yaml_files import seeds

    tree: Any = yaml.safe_load(random.choice(list(seeds(door).values())))
    places = list(mutation._places(tree))
    holder, key = random.choice(places)
    holder[key] = random.choice(
        (
            [0.5] * 60_000,
            [[]] * 30_000,
            {f"k{i}": i for i in range(30_000)},
            "x" * 1_000_000,
            10**4000,
            -(10**4000),
            odd_name(random),
            [odd_name(random)] * 1_000,
            1e308,
            {"file": "/dev/zero"},
            "/dev/zero",
        )
    )
    path = folder / "file.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


def _contents(make: Callable[[Random], str], random: Random, folder: Path) -> Path:
    (folder / ".contents.json").write_text(make(random), encoding="utf-8")
    return folder


def _line(make: Callable[[Random], str], random: Random, folder: Path) -> Path:
    path = folder / "line.json"
    path.write_text(make(random), encoding="utf-8")
    return path


_DOORS = ("controller", "model", "trajectory", "mapping", "stated-robot", "scenario", "experiment", "tune")
TEXTS: dict[str, Callable[[Random, Path], Path]] = {
    **{
        f"{_DOORS[(i + k) % len(_DOORS)]}: YAML {name}": partial(_yaml, make)
        for i, (name, make) in enumerate(_YAML.items())
        for k in (0, 3)
    },
    **{f"{door}: no file": _special for door in _DOORS},
    **{f"{door}: one value": partial(_changed, door) for door in _DOORS},
    **{f"report: JSON {name}": partial(_contents, make) for name, make in _JSON.items()},
    **{f"ticks: JSON {name}": partial(_line, make) for name, make in _JSON.items()},
}
