"""Compiled libraries of the package: wheels contain one per architecture level, source trees compile on first use."""

from __future__ import annotations

import json
import logging
import platform
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, wraps
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import cffi

from diffdrive_mpc.models.compiled.cache import content_digest, load_cached
from diffdrive_mpc.models.compiled.compiler import NotCompiledError, build_digest, build_library, processor_lines

BASELINE = "baseline"
"""Architecture level that every processor of a machine type supports."""
_log = logging.getLogger(__name__)


_Load = TypeVar("_Load", bound=Callable[..., Any])
_LOADING = threading.RLock()


def loaded_once(load: _Load) -> _Load:
    """Cache the result of a loading function, also for threads that call it at the same time.

    Each call of cffi's parser gives types of its own, which functions of another call do not accept.
    """
    cached = cache(load)

    @wraps(load)
    def load_or_wait(*arguments: Any) -> Any:  # noqa: ANN401 - as `load`
        with _LOADING:
            return cached(*arguments)

    load_or_wait.cache_clear = cached.cache_clear  # type: ignore[attr-defined]
    return cast("_Load", load_or_wait)


class Level(NamedTuple):
    """An architecture level, such as x86-64-v3."""

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
        First part of the file names.
    folder
        Folder of the libraries.
    origin
        Digest of all inputs of the build.
    levels
        Architecture levels by name, best first; the last is `BASELINE`. Higher levels exist for x86-64 only.
    """

    name: str
    folder: Path
    origin: str
    levels: Mapping[str, Level]

    def write(self, texts: Mapping[str, str], folder: Path) -> list[Path]:
        """Compile `texts` to libraries in `folder` and write the manifest; skip levels not supported by the compiler.

        Raises
        ------
        NotCompiledError
            If the baseline cannot be compiled.
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
        """Yield the intact libraries that match the sources and that this processor can run, best first."""
        try:
            manifest = json.loads(self._manifest.read_text(encoding="utf-8"))
            if (manifest["origin"], manifest["machine"]) != (self.origin, platform.machine()):
                _log.warning("%s of the package does not match its sources; it is compiled again", self.name)
                return
            entries = [
                (level, self.folder / entry["file"], entry["sha256"]) for level, entry in manifest["libraries"].items()
            ]
        except FileNotFoundError:
            return  # a source tree has no packaged libraries
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            _log.warning("%s cannot be read (%s); %s is compiled again", self._manifest, error, self.name)
            return
        features = _processor_features()
        for level, path, digest in entries:
            if level not in self.levels or not self.levels[level].needs <= features:
                continue
            try:
                if content_digest(path) == digest:
                    yield path
                    continue
            except OSError:
                pass
            _log.warning("%s is damaged; reinstall diffdrive-mpc", path)

    def load(self, texts: Mapping[str, str], declarations: str, error_format: str) -> tuple[cffi.FFI, Any]:
        """Load the library of the only level; compile `texts` if it is not packaged. See `load_library`."""
        (level,) = self.levels.values()

        def build(folder: Path) -> Path:
            return build_library(texts, folder, [level.flags])

        build_inputs = {**texts, "flags": repr(level.flags)}
        return load_library(self.name, declarations, self.libraries(), build_inputs, build, error_format)

    @property
    def _manifest(self) -> Path:
        return self.folder / f"{self.name}.json"


def load_library(
    name: str,
    declarations: str,
    packaged: Iterable[Path],
    build_inputs: Mapping[str, str],
    build: Callable[[Path], Path],
    error_format: str,
) -> tuple[cffi.FFI, Any]:
    """Load declarations and library; if no packaged library can be loaded, compile and cache one.

    Parameters
    ----------
    name
        First part of the file names.
    declarations
        Declarations of the functions and types, in C.
    packaged
        Packaged libraries, best first.
    build_inputs
        Source texts by name, for the key of the cache.
    build
        Function that compiles the library in an empty folder and returns its path.
    error_format
        Format of the error message; `{}` is replaced by the reason and the remedy.

    Raises
    ------
    NotCompiledError
        If no packaged library can be loaded, and none can be compiled.
    """
    ffi = cffi.FFI()
    ffi.cdef(declarations)
    for path in packaged:
        try:
            return ffi, ffi.dlopen(str(path))
        except OSError:  # for instance a wheel for another C library
            continue
    try:
        return ffi, load_cached(name, build_digest(build_inputs), build, lambda path: ffi.dlopen(str(path)))
    except NotCompiledError as error:
        remedy = "install gcc, or diffdrive-mpc from a wheel (pip install diffdrive_mpc-*.whl)"
        raise NotCompiledError(error_format.format(f"{error}; {remedy}")) from error


def _processor_features() -> frozenset[str]:
    """Return the features that all processors of this machine report."""
    # The process may run on any of the processors.
    flags = [frozenset(line.partition(":")[2].split()) for line in processor_lines() if line.startswith("flags")]
    return frozenset.intersection(*flags) if flags else frozenset()
