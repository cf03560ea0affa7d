"""Compile the C sources of `mpc/native` at first use, and keep what comes out by its content."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

from diffdrive_mpc.models.errors import DiffdriveMpcError

NATIVE = Path(__file__).parents[1] / "native"
"""Folder of the C sources and headers."""

CACHE_VARIABLE = "DIFFDRIVE_MPC_CACHE"
"""Environment variable that names the folder of compiled libraries."""

_COMPILERS = ("cc", "gcc", "clang")
_FLAGS = ("-std=c99", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")
# The quickest instructions of this machine; not every compiler knows the first way to ask for them.
_TUNING = (("-march=native", "-mprefer-vector-width=512"), ("-march=native",), ("-mcpu=native",), ())


class NotCompiledError(DiffdriveMpcError, RuntimeError):
    """There is no compiled library; the message says why in one line."""


def compile_library(sources: tuple[str, ...], sizes_header: str) -> Path:
    """The shared library of `sources` (names in `NATIVE`) with the text of ddmpc_sizes.h.

    It is kept under the user's cache folder, in a file named by the hash of all that went into it.

    Raises
    ------
    NotCompiledError
        If there is no compiler, it fails, or the folder cannot be written.
    """
    compiler, version = _compiler()
    digest = hashlib.sha256()
    how = repr((sources, _FLAGS, _TUNING, platform.libc_ver()))
    for part in (version, _machine(), how, sizes_header, _all_sources()):
        digest.update(part.encode() + b"\0")
    library = cache_folder() / f"{Path(sources[0]).stem}-{digest.hexdigest()[:32]}.so"
    if not library.exists():
        try:
            library.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=library.parent) as folder:
                built = _build(compiler, sources, sizes_header, Path(folder))
                # In one step: another process may be at the same.
                built.replace(library)
        except OSError as error:
            raise NotCompiledError(f"{library.parent}: {error.strerror}; set {CACHE_VARIABLE}") from error
    return library


def cache_folder() -> Path:
    """Where compiled libraries are kept.

    Raises
    ------
    NotCompiledError
        If the user has no home folder, and none is named.
    """
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "diffdrive-mpc"
    except RuntimeError as error:
        raise NotCompiledError(f"there is no home folder; set {CACHE_VARIABLE}") from error


@cache
def _compiler() -> tuple[str, str]:
    """Path of the C compiler, and what it says of itself."""
    for name in _COMPILERS:
        path = shutil.which(name)
        if path:
            try:
                answer = subprocess.run([path, "--version"], capture_output=True, text=True, check=True)
            except (OSError, subprocess.CalledProcessError):
                continue
            return path, answer.stdout
    raise NotCompiledError(f"no C compiler ({', '.join(_COMPILERS)}) was found")


@cache
def _machine() -> str:
    """The processor, with all that it can do: code for one may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    known = ("model name", "flags", "Features", "CPU part")
    return platform.machine() + "".join(sorted({line for line in lines if line.startswith(known)}))


@cache
def _all_sources() -> str:
    return "".join(path.read_text(encoding="utf-8") for path in sorted(NATIVE.glob("*.[ch]")))


def _build(compiler: str, sources: tuple[str, ...], sizes_header: str, folder: Path) -> Path:
    (folder / "ddmpc_sizes.h").write_text(sizes_header, encoding="utf-8")
    library = folder / "library.so"
    files = [str(NATIVE / source) for source in sources]
    fault = ""
    for tuning in _TUNING:
        command = [compiler, *_FLAGS, *tuning, f"-I{folder}", *files, "-o", str(library), "-lm"]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode == 0:
            return library
        fault = next((line for line in result.stderr.splitlines() if "error" in line), result.stderr.strip())
    raise NotCompiledError(f"{compiler} failed: {fault}")
