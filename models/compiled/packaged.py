"""Compiled libraries of the package: in a wheel one for each level of the architecture, else compiled at first use."""

from __future__ import annotations

import json
import logging
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cffi

from diffdrive_mpc.models.compiled.cache import content_digest, load_cached
from diffdrive_mpc.models.compiled.compiler import NotCompiledError, build_library, processor_lines, what_is_built

BASELINE = "baseline"
"""The level that every processor of a machine's kind has."""
_log = logging.getLogger(__name__)


class Level(NamedTuple):
    """A level of the architecture."""

    flags: tuple[str, ...]
    """Compiler flags."""
    needs: frozenset[str]
    """Features that the processor must report."""


@dataclass(frozen=True)
class Packaged:
    """One library of the package.

    Attributes
    ----------
    name
        First part of the names of its files.
    folder
        Folder of the libraries.
    origin
        Digest of all that it comes from.
    levels
        By name, best first; the last is `BASELINE`. Higher levels exist for x86-64 only.
    """

    name: str
    folder: Path
    origin: str
    levels: Mapping[str, Level]

    def write(self, texts: Mapping[str, str], folder: Path) -> list[Path]:
        """Compile `texts` for the package in `folder`: libraries and manifest, without levels that the compiler lacks.

        Raises
        ------
        NotCompiledError
            If it cannot be compiled at all.
        """
        libraries = {}
        for level, (flags, _) in self.levels.items():
            if level != BASELINE and platform.machine() not in ("x86_64", "AMD64"):
                continue
            with tempfile.TemporaryDirectory() as build_folder:
                try:
                    built = build_library(texts, Path(build_folder), [flags])
                except NotCompiledError:
                    if level == BASELINE:
                        raise
                    continue
                path = folder / f"{self.name}-{level}.so"
                shutil.copyfile(built, path)
            libraries[level] = {"file": path.name, "sha256": content_digest(path)}
        manifest = {"origin": self.origin, "machine": platform.machine(), "libraries": libraries}
        (folder / self._manifest.name).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
        return [folder / self._manifest.name, *(folder / entry["file"] for entry in libraries.values())]

    def libraries(self) -> Iterator[Path]:
        """Yield the libraries that this processor can run, best first; skip incomplete or outdated ones."""
        try:
            manifest = json.loads(self._manifest.read_text(encoding="utf-8"))
            if (manifest["origin"], manifest["machine"]) != (self.origin, platform.machine()):
                _log.warning("%s of the package does not match its sources; it is compiled again", self.name)
                return
            entries = [
                (level, self.folder / entry["file"], entry["sha256"]) for level, entry in manifest["libraries"].items()
            ]
        except FileNotFoundError:
            return  # a source tree: nothing is packaged
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            _log.warning("%s cannot be read (%s); %s is compiled again", self._manifest, error, self.name)
            return
        has = _processor_has()
        for level, path, digest in entries:
            if level not in self.levels or not self.levels[level].needs <= has:
                continue
            try:
                if content_digest(path) == digest:
                    yield path
                    continue
            except OSError:
                pass
            _log.warning("%s is damaged; reinstall diffdrive-mpc", path)

    def load(self, texts: Mapping[str, str], declarations: str, complaint: str) -> tuple[cffi.FFI, Any]:
        """Load the library of the only level, compiled of `texts` where none is packaged; see `load_library`."""
        (level,) = self.levels.values()

        def build(folder: Path) -> Path:
            return build_library(texts, folder, [level.flags])

        made_of = {**texts, "flags": repr(level.flags)}
        return load_library(self.name, declarations, self.libraries(), made_of, build, complaint)

    @property
    def _manifest(self) -> Path:
        return self.folder / f"{self.name}.json"


def load_library(
    name: str,
    declarations: str,
    packaged: Iterable[Path],
    made_of: Mapping[str, str],
    build: Callable[[Path], Path],
    complaint: str,
) -> tuple[cffi.FFI, Any]:
    """Load the declarations and the library: the one in the package, or else one compiled and cached.

    Parameters
    ----------
    name
        First part of the names of its files.
    declarations
        Declarations of the functions and types, in C.
    packaged
        Libraries that the package brought, best first.
    made_of
        Texts that it comes from.
    build
        Compiles it in an empty folder, and returns where.
    complaint
        Begins the message where it is not there; `{}` stands for the reason and how to get a compiler or a wheel.

    Raises
    ------
    NotCompiledError
        If the package brought no library, and none can be compiled.
    """
    ffi = cffi.FFI()
    ffi.cdef(declarations)
    for path in packaged:
        try:
            return ffi, ffi.dlopen(str(path))
        except OSError:  # such as a wheel for another C library
            continue
    try:
        return ffi, load_cached(name, what_is_built(made_of), build, lambda path: ffi.dlopen(str(path)))
    except NotCompiledError as error:
        remedy = "install gcc, or diffdrive-mpc from a wheel (pip install diffdrive_mpc-*.whl)"
        raise NotCompiledError(complaint.format(f"{error}; {remedy}")) from error


def _processor_has() -> frozenset[str]:
    """Return the features that every processor of this machine reports."""
    flags = [frozenset(line.partition(":")[2].split()) for line in processor_lines() if line.startswith("flags")]
    return frozenset.intersection(*flags) if flags else frozenset()
