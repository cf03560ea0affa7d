"""The compiled core: loading, cache, untrusted files and folders, the compiler, and libraries in wheels."""

import json
import os
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from diffdrive_mpc.models.compiled import cache, compiler
from diffdrive_mpc.models.compiled import packaged as in_wheel
from diffdrive_mpc.models.compiled.compiler import NotCompiledError
from diffdrive_mpc.mpc.core import library, packaged, sources
from imports import imports_of

ROOT = Path(__file__).parents[2]
# A minimal core.
SMALL_CORE = {
    "real.h": "#ifndef REAL_H\n#define REAL_H\n#include <math.h>\n"
    "typedef double real;\ntypedef double ddmpc_time;\n#define R(number) number\n#endif\n",
    "core.h": '#include "real.h"\ntypedef struct { real v, omega; } ddmpc_speed;\n'
    "int ddmpc_answer(void); /* 42 */\nreal ddmpc_length(const ddmpc_speed *speed);\n",
    "answer.c": '#include "core.h"\nint ddmpc_answer(void) { return 42; }\n'
    "real ddmpc_length(const ddmpc_speed *s) { return s->v * s->v + s->omega; }\n",
}


def write(folder, texts):
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text)


def clear_caches():
    loaders = library.load_core, library.load_functions, library._pointers, sources.header_text
    for cached in (*loaders, compiler.find_compiler, cache._process_folder):
        cached.cache_clear()


@pytest.fixture
def core(tmp_path, monkeypatch):
    """Folder with the sources of a minimal core."""
    folder = tmp_path / "core"
    write(folder, SMALL_CORE)
    monkeypatch.setattr(sources, "CORE", folder)
    monkeypatch.setattr(packaged, "CORE", folder)
    # Exclude the generated formulas, which take most of the compile time.
    monkeypatch.setattr(library, "core_texts", sources.written_texts)
    monkeypatch.setattr(packaged, "core_texts", sources.written_texts)
    clear_caches()
    yield folder
    clear_caches()


@pytest.fixture
def folder(core, tmp_path, monkeypatch):
    """Folder of the cache; temporary files are in another folder."""
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path / "cache"))
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(cache.tempfile, "tempdir", str(temporary))
    return tmp_path / "cache"


@pytest.fixture
def no_compiler(folder, monkeypatch):
    monkeypatch.setattr(compiler, "_COMPILERS", ("no-such-compiler",))
    clear_caches()


@pytest.fixture
def compilations(monkeypatch):
    """List with one entry per compilation."""
    calls = []
    build = compiler.build_library

    def count_and_build(*arguments):
        calls.append(arguments)
        return build(*arguments)

    monkeypatch.setattr(library, "build_library", count_and_build)
    return calls


def load_result():
    """Return the result of a function of a freshly loaded core."""
    library.load_core.cache_clear()
    _, lib = library.load_core()
    return lib.ddmpc_answer()


def compile_into_cache():
    """Compile the core into the cache without loading it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library.cffi.FFI, "dlopen", lambda self, name: None)
        library.load_core()
    library.load_core.cache_clear()


def test_threads_that_load_at_the_same_time_get_the_same_library(core):
    with ThreadPoolExecutor(4) as pool:
        loads = list(pool.map(lambda _: library.load_core(), range(4)))
    assert all(load is loads[0] for load in loads)


def only_entry(folder):
    (path,) = folder.iterdir()
    return path


def private_folder(tmp_path):
    return tmp_path / "temporary" / f"diffdrive-mpc-{os.geteuid()}"


def test_core_is_compiled_once_and_cached(folder, compilations):
    assert load_result() == 42
    write_time = only_entry(folder).stat().st_mtime_ns
    assert load_result() == 42
    assert len(compilations) == 1
    assert only_entry(folder).stat().st_mtime_ns == write_time
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_changed_sources_give_a_new_library(folder, core, compilations):
    load_result()
    (core / "answer.c").write_text(SMALL_CORE["answer.c"].replace("42", "43"))
    assert load_result() == 43
    assert len(compilations) == 2


# Libraries that must not be loaded.


def test_digest_covers_every_module_of_the_formulas():
    """After a change of an omitted module, the outdated library would be loaded from the cache."""
    origins = set(sources._FORMULAS)
    modules = {module for module, _ in imports_of(ROOT / "mpc" / "problem" / "formulas.py")}
    own_modules = {module.removeprefix("diffdrive_mpc.") for module in modules if module.startswith("diffdrive_mpc.")}
    assert {f"{module.replace('.', '/')}.py" for module in own_modules} <= origins
    assert len(origins) == len(sources._FORMULAS)


def write_empty(path):
    path.write_bytes(b"")


def truncate(path):
    path.write_bytes(path.read_bytes()[:4096])


def write_text(path):
    path.write_bytes(b"no library")


def write_foreign_library(path):
    """Replace the file with a valid library of different content."""
    source = path.with_suffix(".c")
    source.write_text("int ddmpc_answer(void) { return 666; }")
    subprocess.run(["gcc", "-shared", "-fPIC", source, "-o", path], check=True)
    source.unlink()


def flip_one_bit(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [write_empty, truncate, write_text, write_foreign_library, flip_one_bit])
def test_damaged_or_foreign_library_is_compiled_again(folder, compilations, damage):
    compile_into_cache()
    damage(only_entry(folder))
    assert load_result() == 42
    assert len(compilations) == 2
    # The replacement is found in the cache.
    assert load_result() == 42
    assert len(compilations) == 2


LOAD_SCRIPT = """
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from diffdrive_mpc.mpc.core import library, packaged, sources
sources.CORE = packaged.CORE = Path(sys.argv[1])
library.core_texts = sources.written_texts
print(library.load_core()[1].ddmpc_answer())
"""


def load_in_process(core, **options):
    return subprocess.Popen(
        [sys.executable, "-c", LOAD_SCRIPT, core], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
    )


def test_concurrent_compilations_do_not_collide(folder, core):
    running = [load_in_process(core) for _ in range(2)]
    assert [process.communicate()[0] for process in running] == ["42\n", "42\n"]
    assert only_entry(folder).suffix == ".so"


def test_library_that_fails_to_load_is_compiled_in_the_private_folder(folder, tmp_path, monkeypatch):
    """The file system of the cache forbids execution."""
    ffi_class = library.cffi.FFI
    dlopen = ffi_class.dlopen

    def dlopen_outside_cache(self, name, *flags):
        if name.startswith(str(folder)):
            raise OSError("failed to map segment from shared object")
        return dlopen(self, name, *flags)

    monkeypatch.setattr(ffi_class, "dlopen", dlopen_outside_cache)
    assert load_result() == 42
    assert only_entry(private_folder(tmp_path)).suffix == ".so"


# Folders that must not be used.


def test_folder_writable_by_others_is_not_used(folder, tmp_path, caplog):
    compile_into_cache()
    foreign = only_entry(folder)
    write_foreign_library(foreign)
    foreign.rename(foreign.with_name(f"{foreign.stem.rpartition('-')[0]}-{cache.content_digest(foreign)}.so"))
    folder.chmod(0o777)
    assert load_result() == 42
    assert f"other users can write to {folder}" in caplog.text
    assert cache.CACHE_VARIABLE in caplog.text
    assert stat.S_IMODE(private_folder(tmp_path).stat().st_mode) == 0o700


def change_owner(path, monkeypatch):
    if os.geteuid() == 0:
        os.chown(path, 12345, 12345)
    else:
        user = os.geteuid()
        monkeypatch.setattr(cache.os, "geteuid", lambda: user + 1)


def test_folder_of_another_user_is_not_used(folder, tmp_path, monkeypatch, caplog):
    folder.mkdir(0o700)
    change_owner(folder, monkeypatch)
    assert load_result() == 42
    assert list(folder.iterdir()) == []
    assert f"{folder} belongs to another user" in caplog.text


@pytest.mark.parametrize("kind", ["open", "link", "file"])
def test_prepared_temporary_folder_of_another_user_is_not_used(folder, tmp_path, kind):
    """Another user has created the path of the private folder."""
    folder.mkdir()
    folder.chmod(0o777)
    path = private_folder(tmp_path)
    if kind == "open":
        path.mkdir()
        path.chmod(0o777)
    elif kind == "link":
        (tmp_path / "elsewhere").mkdir(0o700)
        path.symlink_to(tmp_path / "elsewhere")
    else:
        path.write_text("in the way")
    assert load_result() == 42
    assert list(folder.iterdir()) == []
    if kind != "file":
        assert list(path.iterdir()) == []


# The compiler.


def test_error_for_a_missing_compiler_contains_the_wheel(no_compiler):
    with pytest.raises(NotCompiledError) as caught:
        library.load_core()
    message = str(caught.value)
    assert "no C compiler (no-such-compiler) was found" in message
    assert "install gcc, or diffdrive-mpc from a wheel (pip install diffdrive_mpc-*.whl)" in message
    assert "\n" not in message


# The library in the package.


@pytest.fixture
def wheel_core(core, folder):
    """Folder of the minimal core as installed from a wheel."""
    packaged.write_packaged(core)
    clear_caches()
    return core


def test_packaged_library_needs_no_compiler_and_no_cache(wheel_core, no_compiler, folder):
    assert load_result() == 42
    assert not folder.exists()


@pytest.mark.parametrize("damage", [write_empty, truncate, write_text, write_foreign_library, flip_one_bit])
def test_damaged_packaged_library_is_not_loaded(wheel_core, folder, caplog, compilations, damage):
    for path in wheel_core.glob("*.so"):
        damage(path)
    assert load_result() == 42
    assert "is damaged; reinstall diffdrive-mpc" in caplog.text
    assert len(compilations) == 1


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"origin": 1, "machine": 2, "libraries": 3}', "\0"])
def test_damaged_manifest_is_ignored(wheel_core, compilations, text):
    (wheel_core / "ddmpc_core.json").write_text(text)
    assert load_result() == 42
    assert len(compilations) == 1


def test_package_with_a_changed_header_is_compiled_again(wheel_core, compilations):
    """Declarations that differ from the library would access fields at wrong offsets."""
    header = wheel_core / "core.h"
    header.write_text(header.read_text().replace("v, omega", "omega, v"))
    ffi, lib = library.load_core()
    assert lib.ddmpc_length(ffi.new("ddmpc_speed *", {"omega": 1.0, "v": 3.0})) == 10.0
    assert len(compilations) == 1


def test_highest_level_of_the_processor_is_selected(wheel_core, monkeypatch):
    def selected_levels(flags):
        monkeypatch.setattr(in_wheel, "processor_lines", lambda: (f"flags\t\t: {' '.join(flags)}",) * 2)
        return [path.stem.removeprefix("ddmpc_core-") for path in packaged.packaged_libraries()]

    built = set(json.loads((wheel_core / "ddmpc_core.json").read_text())["libraries"])
    assert "baseline" in built
    for level, (_, required) in packaged._LEVELS.items():
        expected = [name for name, (_, flags) in packaged._LEVELS.items() if name in built and flags <= required]
        assert selected_levels(required) == expected, level
        for missing in required:
            assert level not in selected_levels(required - {missing})
    assert selected_levels([]) == ["baseline"]


# The wheel.
