"""The hash of what defines a run: its definition, the files that it names, the product's code, numerical libraries."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path

import diffdrive_mpc_extras
from diffdrive_mpc import models, mpc, sim
from diffdrive_mpc.bench import case, controllers, peers, run_row
from diffdrive_mpc.bench.machine import package_version
from diffdrive_mpc.models.checked_yaml import read_yaml
from diffdrive_mpc.models.compiled.cache import content_digest
from diffdrive_mpc.models.trust import is_trusted
from diffdrive_mpc_extras.campaign.definition import Definition

LIBRARIES = ("numpy", "scipy", "casadi", "osqp", "daqp", "mujoco", "control")
"""Packages whose version can change a number of a run."""
_KINDS = frozenset({".py", ".c", ".h", ".yaml", ".csv", ".npz", ".xml"})


@lru_cache(maxsize=1)
def product_hash() -> str:
    """Hash of the code and the parameter files that a run goes through; what only reports of runs is no part of it.

    The content counts, not the revision: two states of a checkout in which files were changed are told apart, and a
    wheel has the hash of the checkout that it was built from.
    """
    rooms = [_folder(room) for room in (models, mpc, sim, peers, diffdrive_mpc_extras)]
    single = [Path(str(one.__file__)) for one in (case, controllers, run_row)]
    sources = [(path.relative_to(room.parent), path) for room in rooms for path in room.rglob("*")]
    named = {str(name): path for name, path in sources if path.suffix in _KINDS and path.is_file()}
    named |= {path.name: path for path in single}
    total = hashlib.sha256()
    for name in sorted(named):
        total.update(f"{name}\0{_digest(named[name])}\n".encode())
    return total.hexdigest()


@lru_cache(maxsize=1)
def environment() -> dict[str, str]:
    """What a run depends on beside its definition: the product, numerical libraries, Python, kind of processor."""
    libraries = {name: package_version(name) for name in LIBRARIES}
    python = ".".join(platform.python_version_tuple()[:2])
    return {"product": product_hash(), "python": python, "machine": platform.machine(), **libraries}


def identify(definition: Definition) -> dict[str, object]:
    """Everything that the hash of a run covers, as plain data: files by their content, not by their place."""
    factors = {name: _by_content(name, value) for name, value in definition.factors.items()}
    return {"run": factors, "environment": environment()}


def key_of(definition: Definition) -> str:
    """The hash (64 hexadecimal digits) under which a run is stored."""
    text = json.dumps(identify(definition), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _by_content(name: str, value: object) -> object:
    """A path of a file as the hash of its content and of all files that it names in turn."""
    if not isinstance(value, str) or name in ("controller", "timing", "seed"):
        return value
    kind, colon, rest = value.rpartition(":")
    path, plus, more = rest, "", ""
    if not _is_file(path) and "+" in path:
        path, plus, more = rest.rpartition("+")
    if not _is_file(path):
        return value
    contents = {_digest(one) for one in _with_named(Path(path).resolve(), set())}
    return f"{kind}{colon}files {' '.join(sorted(contents))}{plus}{more}"


def _with_named(path: Path, visited: set[Path]) -> Iterator[Path]:
    """A file, the weights beside it, and the files that its text names."""
    if path in visited:
        return
    visited.add(path)
    yield path
    weights = path.with_suffix(".npz")
    if weights != path and weights.is_file():
        yield weights
    if path.suffix in (".yaml", ".yml"):
        for text in _texts(read_yaml(path)):
            if _is_file(path.parent / text):
                yield from _with_named((path.parent / text).resolve(), visited)


def _texts(data: object) -> Iterator[str]:
    if isinstance(data, str):
        yield data
    elif isinstance(data, (Mapping, list)):
        for inner in data.values() if isinstance(data, Mapping) else data:
            yield from _texts(inner)


def _is_file(path: str | Path) -> bool:
    try:
        return str(path) != "" and is_trusted(path) and Path(path).is_file()
    except (OSError, ValueError):  # a sentence is too long for a name
        return False


def _digest(path: Path) -> str:
    state = path.stat()
    return _digest_of(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=4096)
def _digest_of(path: Path, _changed: int, _size: int) -> str:
    return content_digest(path)


def _folder(package: object) -> Path:
    return Path(str(package.__file__)).parent  # type: ignore[attr-defined]
