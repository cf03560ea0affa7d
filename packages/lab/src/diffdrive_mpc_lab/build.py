"""Build of the laboratory: one page that contains the controller as WebAssembly, and its data.

The compiler is that of Zig, from the Python package `ziglang`.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import importlib.util
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from diffdrive_mpc.core_sources import core_texts, require
from diffdrive_mpc.models.checked_yaml import read_yaml
from diffdrive_mpc.models.compiled.compiler import NotCompiledError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.mpc.config.described import schema_rows
from diffdrive_mpc.mpc.config.rooms import EXPERT, shown_key
from diffdrive_mpc_extras.worlds.plug_in import plant_outline
from diffdrive_mpc_lab import numbers
from diffdrive_mpc_lab.numbers import (
    Constants,
    default_of,
    generate_plant,
    generated_texts,
    lab_settings,
    report_fields,
    values_of,
)

BASES = ("model", "horizon", "told")
"""Choices whose constants are stored for each combination."""


class Pool:
    """Pool of arrays by index; equal arrays are stored once."""

    def __init__(self) -> None:
        self._indices: dict[bytes, int] = {}
        self._arrays: list[FloatArray] = []

    def add(self, array: FloatArray) -> int:
        """Add an array and return its index."""
        key = np.ascontiguousarray(array, dtype=float).tobytes()
        if key not in self._indices:
            self._indices[key] = len(self._arrays)
            self._arrays.append(array)
        return self._indices[key]

    @property
    def lengths(self) -> list[int]:
        """Length of each array, in the order of `numbers`."""
        return [array.size for array in self._arrays]

    @property
    def numbers(self) -> bytes:
        """All arrays in order, as little-endian doubles."""
        return np.concatenate(self._arrays).astype("<f8").tobytes()


def page_data() -> tuple[dict[str, Any], bytes]:
    """Build the index and the numbers of the page.

    Raises
    ------
    ValueError
        If two choices change the same constant, because the page cannot combine them.
    """
    pool, settings = Pool(), lab_settings()
    index = {
        "choices": {name: _describe_choice(choice) for name, choice in settings["choices"].items()},
        "robot": pool.add(numbers.flat(numbers.robot())),
        "peer": pool.add(numbers.flat(numbers.peer())),
        "drawing": pool.add(numbers.flat(numbers.drawing())),
        "floors": {name: pool.add(numbers.flat(numbers.floor(name))) for name in values_of("surface")},
        "sensors": {name: pool.add(numbers.flat(numbers.sensors(name))) for name in values_of("sensors")},
        "noise": {seed: pool.add(numbers.noise(seed)) for seed in values_of("seed")},
        "models": {
            f"{name} {dead_time}": pool.add(numbers.plant_model(name, dead_time))
            for name, dead_time in product(values_of("robot"), values_of("dead"))
        },
        "references": {name: pool.add(table) for name, table in _references()},
        "controllers": {key: _controller(pool, choices) for key, choices in _base_choices()},
        "files": {model: _configuration_groups(model) for model in values_of("model")},
        "ice": settings["ice"],
        "drawn": settings["drawing"],
        "push": settings["push"],
        "longest_link": settings["longest_link"],
        "outline": plant_outline("model:ssm"),
        "limits": {"v": load_robot().limits.v, "omega": load_robot().limits.omega},
        "too_far": numbers.configuration(default_of("model"), {}).failure.max_position_error,
        "experiments": experiments(),
    }
    return index | {"lengths": pool.lengths}, pool.numbers


def _configuration_groups(model: str) -> dict[str, Any]:
    """Return the groups of the configuration of `model` that differ from the defaults, in the sections of a file."""
    groups = numbers.configuration(model, {}).model_dump(mode="json", exclude_defaults=True)
    expert_groups = {name: groups.pop(name) for name in tuple(groups) if shown_key(name) != name}
    return {**groups, EXPERT: expert_groups}


def experiments() -> list[dict[str, Any]]:
    """Load the guided experiments, `experiments.yaml`."""
    loaded: list[dict[str, Any]] = read_yaml(Path(__file__).with_name("experiments.yaml"))["experiments"]
    return loaded


def _describe_choice(choice: Mapping[str, Any]) -> dict[str, Any]:
    """Add key, help and unit of the configuration schema to a choice."""
    rows = {row.key: row for row in schema_rows()}
    row = rows.get(shown_key(choice.get("key", "")))
    description = {} if row is None else {"shown": row.key, "help": row.help, "unit": row.unit}
    return {**choice, **description}


def _references() -> Iterator[tuple[str, FloatArray]]:
    for path, speed in product(values_of("path"), values_of("speed")):
        table = numbers.reference(path, speed)
        if table is not None:
            yield f"{path} {speed}", table


def _base_choices() -> Iterator[tuple[str, dict[str, Any]]]:
    for combination in product(*map(values_of, BASES)):
        yield " ".join(map(str, combination)), dict(zip(BASES, combination, strict=True))


def _controller(pool: Pool, choices: dict[str, Any]) -> dict[str, Any]:
    """Collect sizes and fields of a base, and fields, indices and values of each continuous choice."""
    model, rest = choices["model"], {name: choices[name] for name in BASES if name != "model"}
    base = numbers.controller(numbers.configuration(model, rest))
    varied: dict[str, list[Any]] = {}
    touched: set[tuple[int, int]] = set()
    for name, power in numbers.powers().items():
        varied[name] = []
        for field, indices, units in _proportional(base, model, rest, name, power):
            if touched & (changed := {(field, index) for index in indices}):
                raise ValueError(f"{name}: it changes the same constants as another choice; remove one of them")
            touched |= changed
            varied[name].append([field, indices, pool.add(units)])
    return {"sizes": pool.add(base.sizes), "fields": [pool.add(f) for f in base.fields.values()], "varied": varied}


def _proportional(
    base: Constants, model: str, rest: dict[str, Any], name: str, power: float
) -> Iterator[tuple[int, list[int], FloatArray]]:
    """Yield the fields that a choice changes, the indices, and the values divided by the power of its value."""
    values = values_of(name)
    variants = [numbers.controller(numbers.configuration(model, rest | {name: value})) for value in values]
    for field, constants in enumerate(zip(*(varied.fields.values() for varied in variants), strict=True)):
        table, original = np.array(constants), list(base.fields.values())[field]
        indices = np.flatnonzero(~((table == original) | (np.isnan(table) & np.isnan(original))).all(axis=0))
        units = table[:, indices] / np.power(values, power)[:, None]
        if not np.allclose(units, units[0], rtol=1e-12, atol=0.0):
            raise ValueError(f"{name}: its constants are not proportional to its value to the power of {power}")
        if indices.size:
            yield field, indices.tolist(), units[0]


require(1)

FOLDER = Path(__file__).parent
_FLAGS = (
    *("-target", "wasm32-wasi", "-mexec-model=reactor", "-std=c99", "-O3", "-msimd128", "-s"),
    # Without contraction, all browsers give identical results.
    *("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-DDDMPC_NOW=lab_now"),
)
_MAX_COMPILE_TIME = 300.0
"""Time limit of the compiler [s]; the first call on a machine also compiles a C library."""
_ZERO = 1e-12
"""Magnitude below which numbers are rounding errors, which differ between machines."""
SCRIPTS = ("engine.js", "settings.js", "view.js", "page.js")


def has_compiler() -> bool:
    """Return True if Zig is installed for this Python."""
    return importlib.util.find_spec("ziglang") is not None


def texts() -> dict[str, str]:
    """Return the texts of all C files and headers by name."""
    plant = generate_plant()
    written = {path.name: path.read_text(encoding="utf-8") for path in sorted(FOLDER.glob("*.[ch]"))}
    generated = {f"{plant.stem}.c": plant.source, f"{plant.stem}.h": plant.header}
    return core_texts() | generated | generated_texts() | written


def compile_module() -> bytes:
    """Compile the WebAssembly module.

    Raises
    ------
    NotCompiledError
        If the compiler is missing or fails.
    """
    if not has_compiler():
        raise NotCompiledError("the laboratory needs Zig's C compiler: pip install ziglang")
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for name, text in texts().items():
            (folder / name).write_text(text, encoding="utf-8")
        sources = [str(path) for path in sorted(folder.glob("*.c"))]
        command = [sys.executable, "-m", "ziglang", "cc", *_FLAGS, f"-I{folder}", *sources, "-o", f"{folder}/lab.wasm"]
        process = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_MAX_COMPILE_TIME)
        if process.returncode:
            reason = next((line for line in process.stderr.splitlines() if "error" in line), "unknown compiler error")
            raise NotCompiledError(f"the laboratory could not be compiled: {reason}")
        return (folder / "lab.wasm").read_bytes()


def page_text() -> str:
    """Build the page; raises NotCompiledError as `compile_module`."""
    module = compile_module()
    index, numbers = _data_of_page()
    parts = {"module": module, "numbers": numbers, "index": index}
    held = {name: base64.b64encode(gzip.compress(part, 9, mtime=0)).decode() for name, part in parts.items()}
    held_text = "".join(f'<script type="text/plain" id="held-{name}">{text}</script>' for name, text in held.items())
    placeholders = _placeholder_texts()
    page = placeholders.pop("PAGE")
    for mark, text in {**placeholders, "HELD": held_text, "SOURCES": sources_digest()}.items():
        page = page.replace(f"<!--{mark}-->", text)
    return page


def sources_digest() -> str:
    """Return the SHA-256 of all inputs of the page: C sources, flags, scripts, and data rounded to six digits."""
    index, data = _data_of_page()
    rounded = [f"{number:.5e}" if abs(number) > _ZERO else "0" for number in np.frombuffer(data, "<f8").tolist()]
    texts_of_page = {**texts(), **_placeholder_texts(), "flags": " ".join(_FLAGS), "index": index.decode()}
    return hashlib.sha256(json.dumps([texts_of_page, rounded], sort_keys=True).encode()).hexdigest()


@cache
def _data_of_page() -> tuple[bytes, bytes]:
    """Build index and numbers of the page as bytes."""
    index, data = page_data()
    index["report"] = report_fields((FOLDER / "lab.h").read_text(encoding="utf-8"))
    return json.dumps(index, allow_nan=False).encode(), data


def _placeholder_texts() -> dict[str, str]:
    """Return page, style and script, by their placeholders in the page."""
    folder = FOLDER / "page"
    script = "\n".join((folder / name).read_text(encoding="utf-8") for name in SCRIPTS)
    files = {"PAGE": "page.html", "STYLE": "page.css"}
    return {mark: (folder / name).read_text(encoding="utf-8") for mark, name in files.items()} | {"SCRIPT": script}
