"""The compiled core inside a wheel: one library for each level of x86-64, and a manifest with their digests.

A wheel runs on processors that its maker has not seen. On x86-64 the core is therefore compiled for the levels 3 and 4
of the architecture too (AVX2, AVX-512), and the best one that the processor has is loaded.
"""

from __future__ import annotations

import json
import logging
import platform
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from diffdrive_mpc.mpc.core.cache import content_digest
from diffdrive_mpc.mpc.core.compiler import PLAIN_REST, NotCompiledError, build_library, processor_lines
from diffdrive_mpc.mpc.core.sources import CORE, core_origin, core_texts

_MANIFEST = "ddmpc_core.json"
_BASELINE = "baseline"
# Best first: flags, and what the processor must say that it has.
_V3 = frozenset(("avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"))
_V4 = _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
_LEVELS: dict[str, tuple[tuple[str, ...], frozenset[str]]] = {
    "x86-64-v4": (("-march=x86-64-v4", "-mprefer-vector-width=512", PLAIN_REST), _V4),
    "x86-64-v3": (("-march=x86-64-v3",), _V3),
    _BASELINE: ((), frozenset()),
}
_log = logging.getLogger(__name__)


def write_packaged(folder: Path) -> list[Path]:
    """Compile the core for the package in `folder`: libraries and manifest; without the levels that the compiler lacks.

    Raises
    ------
    NotCompiledError
        If it cannot be compiled at all.
    """
    texts, libraries = core_texts(), {}
    for level, (flags, _) in _LEVELS.items():
        if level != _BASELINE and platform.machine() not in ("x86_64", "AMD64"):
            continue
        with tempfile.TemporaryDirectory() as build_folder:
            try:
                built = build_library(texts, Path(build_folder), [flags])
            except NotCompiledError:
                if level == _BASELINE:
                    raise
                continue
            path = folder / f"ddmpc_core-{level}.so"
            shutil.copyfile(built, path)
        libraries[level] = {"file": path.name, "sha256": content_digest(path)}
    manifest = {"origin": core_origin(), "machine": platform.machine(), "libraries": libraries}
    (folder / _MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return [folder / _MANIFEST, *(folder / entry["file"] for entry in libraries.values())]


def packaged_libraries() -> Iterator[Path]:
    """The package's libraries that this processor can run, best first; only whole ones, and only of these sources."""
    try:
        manifest = json.loads((CORE / _MANIFEST).read_text(encoding="utf-8"))
        if (manifest["origin"], manifest["machine"]) != (core_origin(), platform.machine()):
            _log.warning("the compiled core of the package is not of its sources; it is compiled anew")
            return
        entries = [(level, CORE / entry["file"], entry["sha256"]) for level, entry in manifest["libraries"].items()]
    except FileNotFoundError:
        return  # a source tree: nothing is packaged
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        _log.warning("%s cannot be read (%s); the core is compiled anew", CORE / _MANIFEST, error)
        return
    has = _processor_has()
    for level, path, digest in entries:
        if level not in _LEVELS or not _LEVELS[level][1] <= has:
            continue
        try:
            if content_digest(path) == digest:
                yield path
                continue
        except OSError:
            pass
        _log.warning("%s is damaged; reinstall diffdrive-mpc", path)


def _processor_has() -> frozenset[str]:
    """What every processor here says that it can do."""
    flags = [frozenset(line.partition(":")[2].split()) for line in processor_lines() if line.startswith("flags")]
    return frozenset.intersection(*flags) if flags else frozenset()
