"""The C sources are compiled once and kept; without a compiler the controller runs in Python and says so."""

import logging
import subprocess
import sys

import numpy as np
import pytest
from diffdrive_mpc.mpc.compiled import compiler, library
from diffdrive_mpc.mpc.compiled.compiler import NotCompiledError, compile_library
from diffdrive_mpc.mpc.compiled.reference import CompiledReference

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc import Controller, load_config
from diffdrive_mpc.mpc.config.config_file import replace_values


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv(compiler.CACHE_VARIABLE, str(tmp_path / "cache"))
    library._load.cache_clear()
    yield tmp_path / "cache"
    library._load.cache_clear()


@pytest.fixture
def no_compiler(folder, monkeypatch):
    monkeypatch.setattr(compiler, "_COMPILERS", ("no-such-compiler",))
    compiler._compiler.cache_clear()
    library._warn_once.cache_clear()
    yield
    compiler._compiler.cache_clear()
    library._warn_once.cache_clear()


def config(choice):
    return replace_values(load_config("ssm"), {"solver.compiled": choice, "horizon": 10})


def test_a_library_is_compiled_once(folder):
    first = compile_library(("reference.c",), "")
    written = first.stat().st_mtime_ns
    assert compile_library(("reference.c",), "") == first
    assert first.stat().st_mtime_ns == written
    assert [path.name for path in folder.iterdir()] == [first.name]


def test_another_content_is_another_library(folder):
    assert compile_library(("reference.c",), "") != compile_library(("reference.c",), "#define OTHER 1\n")


def test_processes_that_compile_at_once_do_not_collide(folder):
    code = (
        "from mpc.compiled.reference import *; from mpc import *\n"
        "print(compile_reference(load_trajectory('s')).sample([2.0]))"
    )
    running = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = {process.communicate()[0] for process in running}
    assert len(said) == 1
    assert [process.returncode for process in running] == [0, 0]
    assert len(list(folder.iterdir())) == 1


def test_a_folder_that_cannot_be_written_says_what_to_set(folder):
    folder.write_text("a file in the way")
    with pytest.raises(NotCompiledError, match=compiler.CACHE_VARIABLE):
        compile_library(("reference.c",), "")


def test_a_library_that_cannot_be_loaded_says_so(folder):
    path = compile_library(("reference.c",), library.sizes_header({}))
    path.write_bytes(b"no library")
    with pytest.raises(NotCompiledError, match="cannot be loaded"):
        library.load_library(("reference.c",), {})


def test_with_a_compiler_the_controller_is_compiled():
    assert Controller(config("auto")).compiled
    assert Controller(config("always")).compiled
    assert not Controller(config("never")).compiled


def test_without_a_compiler_it_runs_in_python_and_says_so_once(no_compiler, caplog):
    with caplog.at_level(logging.WARNING):
        controller = Controller(config("auto"))
    assert not controller.compiled
    (record,) = caplog.records
    assert "no C compiler" in record.getMessage()


def test_without_a_compiler_always_is_refused(no_compiler):
    with pytest.raises(ConfigError, match="install gcc, or set it to auto"):
        Controller(config("always"))


def test_many_times_at_once_are_sampled_in_python():
    from diffdrive_mpc.mpc import load_trajectory

    circle = load_trajectory("circle")
    times = np.linspace(0, circle.duration, 2000)
    assert (CompiledReference(circle).sample(times).pose == circle.sample(times).pose).all()
