"""C compiler: selection, flags and time limit. This module needs only Python's standard library."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import signal
import subprocess
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

from diffdrive_mpc.models.errors import DiffdriveMpcError

_COMPILERS = ("cc", "gcc", "clang")
_FLAGS = (
    "-std=c99",
    "-O3",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-semantic-interposition",
    "-fPIC",
)
# Disable an optimisation in which GCC 12 wrongly assumes alignment in loop remainders, because it crashes the process.
NO_VECTOR_EPILOGUES = "--param=vect-epilogues-nomask=0"
# Not every compiler accepts all flags for the fastest instructions of this machine.
NATIVE: tuple[tuple[str, ...], ...] = (
    ("-march=native", "-mprefer-vector-width=512", NO_VECTOR_EPILOGUES),
    ("-march=native", "-mprefer-vector-width=512"),
    ("-march=native",),
    ("-mcpu=native",),
    (),
)
"""Sets of flags for the processor of this machine, in the order in which they are tried."""

_COMPILE_TIMEOUT, _VERSION_TIMEOUT = 120.0, 10.0  # [s]


class NotCompiledError(DiffdriveMpcError, RuntimeError):
    """Error if a library is neither available nor can be compiled: one line with reason and remedy."""


def build_library(texts: Mapping[str, str], folder: Path, tunings: Sequence[Sequence[str]]) -> Path:
    """Write `texts` (name to text) to `folder` and compile its C files to one shared library there.

    Parameters
    ----------
    texts
        C files and headers by name.
    folder
        An empty folder.
    tunings
        Sets of flags for the processor; the first set that the compiler accepts is used.

    Raises
    ------
    NotCompiledError
        If there is no compiler, or if it fails or takes too long.
    OSError
        If the folder is not writable.
    """
    compiler, _ = find_compiler()
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    sources = sorted(name for name in texts if name.endswith(".c"))
    fault = ""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for tuning in tunings:
            command = [compiler, *_FLAGS, *tuning]
            # Run in the folder with relative names, so that the library contains no paths.
            jobs = [pool.submit(_compile_error, [*command, "-c", source], folder) for source in sources]
            fault = next((job.result() for job in jobs if job.result()), "")
            if not fault:
                objects = [f"{Path(source).stem}.o" for source in sources]
                fault = _compile_error([*command, "-shared", *objects, "-o", "library.so", "-lm"], folder)
            if not fault:
                return folder / "library.so"
    raise NotCompiledError(f"{compiler} failed: {fault}")


def _compile_error(command: Sequence[str], folder: Path) -> str:
    """Run a compiler command and return its error message in one line; an empty string on success.

    Raises
    ------
    NotCompiledError
        If the compiler exceeds its time limit.
    """
    try:
        code, _, output = _run(command, _COMPILE_TIMEOUT, folder)
    except TimeoutError as error:
        raise NotCompiledError(f"{command[0]} did not finish within {_COMPILE_TIMEOUT:g} s") from error
    if code == 0:
        return ""
    return next((line for line in output.splitlines() if "error" in line), output.strip() or f"exit code {code}")


def build_digest(texts: Mapping[str, str]) -> str:
    """Compute the digest of all inputs of a library for this machine: texts, compiler, flags and processor.

    Raises
    ------
    NotCompiledError
        If there is no compiler.
    """
    _, version = find_compiler()
    settings = repr((_FLAGS, NATIVE, platform.libc_ver()))
    return digest_of([version, _machine(), settings, *(part for item in sorted(texts.items()) for part in item)])


def digest_of(parts: Sequence[str]) -> str:
    """Compute the SHA-256 of texts, in hexadecimal digits."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()


@cache
def find_compiler() -> tuple[str, str]:
    """Find the C compiler; return its path and its version text.

    Raises
    ------
    NotCompiledError
        If there is no working compiler.
    """
    for name in _COMPILERS:
        path = shutil.which(name)
        if path:
            try:
                code, version, _ = _run([path, "--version"], _VERSION_TIMEOUT)
            except OSError:  # includes TimeoutError
                continue
            if code == 0:
                return path, version
    raise NotCompiledError(f"no C compiler ({', '.join(_COMPILERS)}) was found")


def _run(command: Sequence[str], timeout: float, folder: Path | None = None) -> tuple[int, str, str]:
    """Run a command; return exit code, standard output and standard error.

    Raises
    ------
    TimeoutError
        If the command ran longer than `timeout` seconds and was killed with its children.
    """
    process = subprocess.Popen(
        command,
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        # A separate process group, so that the compiler's children can be killed with it.
        start_new_session=True,
    )
    with process:
        try:
            output, errors = process.communicate(timeout=timeout)
        except BaseException as error:
            os.killpg(process.pid, signal.SIGKILL)
            if isinstance(error, subprocess.TimeoutExpired):
                raise TimeoutError(f"{command[0]}: not finished after {timeout:g} s") from error
            raise
    return process.returncode, output, errors


@cache
def _machine() -> str:
    """Describe the processor with its features, because code for one processor may not run on another."""
    known = ("model name", "flags", "Features", "CPU part")
    return platform.machine() + "".join(sorted({line for line in processor_lines() if line.startswith(known)}))


@cache
def processor_lines() -> tuple[str, ...]:
    """Return the lines of /proc/cpuinfo; on systems without that file, the processor name from `platform`."""
    try:
        return tuple(Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines())
    except OSError:
        return (f"model name: {platform.processor()}",)
