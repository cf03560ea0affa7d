"""Packages of ROS types in a folder of the cache: made once, and again where something that they come from changed."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import distributions
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.compiled.cache import user_folder
from diffdrive_mpc.models.compiled.compiler import digest_of
from diffdrive_mpc.models.errors import DiffdriveMpcError

INTERFACES = Path(__file__).with_name("interfaces")
PACKAGES = tuple(sorted(path.name for path in INTERFACES.iterdir() if path.is_dir()))
"""Packages that are made here."""

_COMPILERS = {".c": ("gcc", "-std=c11"), ".cpp": ("g++", "-std=c++17")}
TYPE_SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
"""What Fast DDS asks for: how a message is sent, and how it is described."""

_LIBRARIES = ("rosidl_generator_c", "rosidl_generator_py", "rosidl_typesupport_c", *TYPE_SUPPORTS)
_ALSO = ("rosidl_runtime_c", "rosidl_typesupport_c", *TYPE_SUPPORTS, "fastcdr", "rcutils")
# A type support is looked up by the name of its library, which the loader knows once it has been loaded.
_INIT = """import ctypes as _ctypes
import pathlib as _pathlib

for _library in _pathlib.Path(__file__).parent.glob("lib*__rosidl_typesupport_*.so"):
    _ctypes.CDLL(str(_library))
"""
_PATIENCE = 300.0  # [s] for one step


class TypesError(DiffdriveMpcError, RuntimeError):
    """The types cannot be made; says why, and the remedy."""


def built_types() -> Path:
    """The folder that holds the packages, to be put on the module search path; made first where there is none.

    Nothing else has to be set: the libraries of the wheels are found where `rclpy` finds them.

    Raises
    ------
    TypesError
        If a wheel or a compiler is missing, or one of them fails.
    OSError
        If the cache cannot be written.
    """
    prefix = Path(sys.prefix)
    if not (prefix / "share" / "rosidl_generator_py" / "resource").is_dir():
        raise TypesError("there are no generators of ROS types here: pip install 'diffdrive-mpc[dev]'")
    cache = user_folder()
    cache.mkdir(mode=0o700, parents=True, exist_ok=True)
    stem = f"ros-types-{_origin()[:32]}"
    for folder in sorted(cache.glob(f"{stem}-*")):
        if _content(folder) == folder.name.rpartition("-")[2]:
            return folder
        shutil.rmtree(folder)
    with tempfile.TemporaryDirectory(dir=cache, prefix="build-") as work:
        made = Path(work) / "types"
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(lambda package: _make(package, prefix, Path(work) / "sources", made), PACKAGES))
        folder = cache / f"{stem}-{_content(made)}"
        try:
            # In one step: another process may be at the same.
            made.replace(folder)
        except OSError:
            if not folder.is_dir():
                raise
    return folder


def search_path(folder: Path, known: str = "") -> str:
    """PYTHONPATH `known` with `folder` in front of it."""
    return os.pathsep.join([str(folder), *(part for part in known.split(os.pathsep) if part and part != str(folder))])


def _make(package: str, prefix: Path, sources: Path, made: Path) -> None:
    generated = sources / package
    generated.mkdir(parents=True)
    _run(
        [sys.executable, "-m", f"{__package__}.generate", package, INTERFACES / package, prefix / "share", generated],
        {"AMENT_PREFIX_PATH": str(prefix)},
    )
    paths = [sysconfig.get_path("include"), np.get_include(), *sorted(generated.iterdir()), prefix / "include"]
    paths += sorted(path for path in (prefix / "include").iterdir() if path.is_dir())
    objects = []
    for source in [path for path in sorted(generated.rglob("*")) if path.suffix in _COMPILERS]:
        objects.append(source.with_suffix(f"{source.suffix}.o"))
        _run(
            [
                *_COMPILERS[source.suffix],
                "-O1",
                "-fPIC",
                "-c",
                source,
                *(f"-I{path}" for path in paths),
                "-o",
                objects[-1],
            ]
        )
    target = made / package
    python = generated / "py" / package
    for path in sorted(python.rglob("*.py")):
        (target / path.relative_to(python)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target / path.relative_to(python))
    (target / "__init__.py").write_text(_INIT, encoding="utf-8")
    entry = python / f"_{package}_s.ep.rosidl_typesupport_c.c.o"
    objects.remove(entry)
    code = f"lib{package}__types.so"
    _link(target / code, [*objects, "-Wl,--as-needed", *_libraries(prefix / "lib")])
    # All is in one library; it goes by the names that are looked up, too.
    for name in (f"lib{package}__{kind}.so" for kind in TYPE_SUPPORTS):
        _link(target / name, ["-Wl,--no-as-needed", target / code])
    _link(target / f"{package}_s__rosidl_typesupport_c.so", [entry, target / code])


def _link(library: Path, inputs: Sequence[str | Path]) -> None:
    _run(["g++", "-shared", *inputs, f"-Wl,-soname,{library.name}", "-Wl,-rpath,$ORIGIN", "-o", library])


def _libraries(folder: Path) -> Iterator[Path]:
    """Libraries of all packages of types, and those that they all need."""
    for kind in _LIBRARIES:
        yield from sorted(folder.glob(f"lib*__{kind}.so"))
    yield from (folder / f"lib{name}.so" for name in _ALSO)


def _run(command: Sequence[str | Path], environment: dict[str, str] | None = None) -> None:
    words = [str(word) for word in command]
    try:
        done = subprocess.run(
            words,
            env={**os.environ, **(environment or {})},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_PATIENCE,
            check=False,
        )
    except FileNotFoundError as error:
        raise TypesError(f"{words[0]} was not found: ROS types need GCC (apt-get install g++)") from error
    except subprocess.TimeoutExpired as error:
        raise TypesError(f"{words[0]} did not finish within {_PATIENCE:g} s") from error
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "rror" in line] or done.stderr.splitlines() or ["no word"]
        raise TypesError(f"{' '.join(words[:4])} ... failed: {lines[-1].strip()}")


def _origin() -> str:
    """Digest of all that the packages come from: definitions, generators, the types they build on, and the Python."""
    texts = [str(path.relative_to(INTERFACES)) + path.read_text(encoding="utf-8") for path in _files(INTERFACES)]
    wheels = sorted(
        f"{distribution.name} {distribution.version}"
        for distribution in distributions()
        if (distribution.name or "").startswith("ros-")
    )
    code = [path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("*.py"))]
    here = [sysconfig.get_config_var("EXT_SUFFIX") or "", platform.machine(), np.__version__]
    return digest_of([*texts, *wheels, *code, *here])


def _content(folder: Path) -> str:
    """Digest of what a folder of packages holds, without what Python keeps beside it."""
    digest = hashlib.sha256()
    for path in _files(folder):
        digest.update(str(path.relative_to(folder)).encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:32]


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
