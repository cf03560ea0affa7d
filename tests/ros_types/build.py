"""Build the ROS types that have no wheel (nav2_msgs, tf2_msgs, bond) in a folder of the cache, once per definition."""

from __future__ import annotations

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

INTERFACES = Path(__file__).with_name("interfaces")
PACKAGES = tuple(sorted(path.name for path in INTERFACES.iterdir() if path.is_dir()))
"""Packages that this module builds."""

_COMPILERS = {".c": ("gcc", "-std=c11"), ".cpp": ("g++", "-std=c++17")}
TYPE_SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
"""Type supports that Fast DDS loads."""

_LIBRARIES = ("rosidl_generator_c", "rosidl_generator_py", "rosidl_typesupport_c", *TYPE_SUPPORTS)
_ALSO = ("rosidl_runtime_c", "rosidl_typesupport_c", *TYPE_SUPPORTS, "fastcdr", "rcutils")
# A type support is looked up by the name of its library, which the loader knows once it has been loaded.
_INIT = """import ctypes as _ctypes
import pathlib as _pathlib

for _library in _pathlib.Path(__file__).parent.glob("lib*__rosidl_typesupport_*.so"):
    _ctypes.CDLL(str(_library))
"""
_STEP_TIMEOUT = 300.0  # time limit of one step [s]


def built_types() -> Path:
    """Return the folder of the packages, for the module search path; build them first if necessary.

    Raises
    ------
    RuntimeError
        If a wheel or a compiler is missing, or one of them fails.
    """
    prefix = Path(sys.prefix)
    if not (prefix / "share" / "rosidl_generator_py" / "resource").is_dir():
        raise RuntimeError("there are no generators of ROS types: pip install 'diffdrive-mpc[dev]'")
    folder = user_folder() / f"ros-types-{_origin()[:32]}"
    if folder.is_dir():
        return folder
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix="build-") as work:
        built = Path(work) / "types"
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(lambda package: _make(package, prefix, Path(work) / "sources", built), PACKAGES))
        try:
            # One step, because another process may build the same folder.
            built.replace(folder)
        except OSError:
            if not folder.is_dir():
                raise
    return folder


def search_path(folder: Path, known: str = "") -> str:
    """Return PYTHONPATH `known` with `folder` in front of it."""
    return os.pathsep.join([str(folder), *(part for part in known.split(os.pathsep) if part and part != str(folder))])


def add_types() -> Path:
    """Make the types importable in this process and its children; return their folder; errors as in `built_types`."""
    folder = built_types()
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    os.environ["PYTHONPATH"] = search_path(folder, os.environ.get("PYTHONPATH", ""))
    return folder


def _make(package: str, prefix: Path, sources: Path, target_folder: Path) -> None:
    generated = sources / package
    generated.mkdir(parents=True)
    script = Path(__file__).with_name("generate.py")
    folders = (INTERFACES / package, prefix / "share", generated)
    _run([sys.executable, script, package, *folders, *TYPE_SUPPORTS], {"AMENT_PREFIX_PATH": str(prefix)})
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
    target = target_folder / package
    python = generated / "py" / package
    for path in sorted(python.rglob("*.py")):
        (target / path.relative_to(python)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target / path.relative_to(python))
    (target / "__init__.py").write_text(_INIT, encoding="utf-8")
    entry = python / f"_{package}_s.ep.rosidl_typesupport_c.c.o"
    objects.remove(entry)
    code = f"lib{package}__types.so"
    _link(target / code, [*objects, "-Wl,--as-needed", *_libraries(prefix / "lib")])
    # All types are in one library, which also needs the names that are looked up.
    for name in (f"lib{package}__{kind}.so" for kind in TYPE_SUPPORTS):
        _link(target / name, ["-Wl,--no-as-needed", target / code])
    _link(target / f"{package}_s__rosidl_typesupport_c.so", [entry, target / code])


def _link(library: Path, inputs: Sequence[str | Path]) -> None:
    _run(["g++", "-shared", *inputs, f"-Wl,-soname,{library.name}", "-Wl,-rpath,$ORIGIN", "-o", library])


def _libraries(folder: Path) -> Iterator[Path]:
    """Yield the libraries of all installed packages of types, and the libraries that they need."""
    for kind in _LIBRARIES:
        yield from sorted(folder.glob(f"lib*__{kind}.so"))
    yield from (folder / f"lib{name}.so" for name in _ALSO)


def _run(command: Sequence[str | Path], environment: dict[str, str] | None = None) -> None:
    arguments = [str(word) for word in command]
    try:
        done = subprocess.run(
            arguments,
            env={**os.environ, **(environment or {})},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_STEP_TIMEOUT,
            check=False,
        )
    except FileNotFoundError as error:
        raise RuntimeError(f"{arguments[0]} was not found: ROS types need GCC (apt-get install g++)") from error
    except subprocess.TimeoutExpired as error:
        raise RuntimeError(f"{arguments[0]} did not finish within {_STEP_TIMEOUT:g} s") from error
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "rror" in line] or done.stderr.splitlines() or ["none"]
        raise RuntimeError(f"{' '.join(arguments[:4])} ... failed: {lines[-1].strip()}")


def _origin() -> str:
    """Return a digest of definitions, generators, installed ROS packages and the Python version."""
    files = sorted(path for path in Path(__file__).parent.rglob("*") if path.suffix in {".py", ".msg", ".action"})
    texts = [f"{path.name}\n{path.read_text(encoding='utf-8')}" for path in files]
    names = ((distribution.name or "", distribution.version) for distribution in distributions())
    wheels = sorted(f"{name} {number}" for name, number in names if name.startswith("ros-"))
    return digest_of(
        [*texts, *wheels, sysconfig.get_config_var("EXT_SUFFIX") or "", platform.machine(), np.__version__]
    )
