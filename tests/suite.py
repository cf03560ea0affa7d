"""Test suite setup: one hypothesis profile, the system suite, real logs, order of files, ROS types without a wheel.

The hypothesis profile draws the same examples on every run, without a deadline; `--hypothesis-profile=many` draws more.
"""

import ctypes
import os
import shutil
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from hypothesis import settings

settings.register_profile("reproducible", deadline=None, derandomize=True, print_blob=False, max_examples=25)
settings.register_profile("many", settings.get_profile("reproducible"), max_examples=200)
settings.load_profile("reproducible")
# The command line also sets these variables before NumPy is imported.
for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")
# Workers of xdist set a width; without it, tables are as wide as in a pipe.
os.environ.pop("COLUMNS", None)

SYSTEM_PACKAGES = yaml.safe_load(Path(__file__).with_name("system_packages.yaml").read_text(encoding="utf-8"))
"""Programs and shared libraries with their Debian packages, by need of a test marked `system`."""
LONG_TESTS = {"core_library", "documents", "export", "hybrids", "identify_command", "identify_truth", "tutorials"}
LONG_TESTS |= {"model_comparison", "monitor_with_node", "over_dds", "replay", "reproduce_experiments", "wirings"}
"""Files with a test or fixture of five seconds or more: they run first, so that no core waits at the end."""
LOGS = os.environ.get("DIFFDRIVE_MPC_DATA")
SKIP_REASONS = {
    "system": f"need processes, many drives or Debian packages ({', '.join(SYSTEM_PACKAGES)}): make test-system",
    "long": "take long: .ci/long tests",
    "real_logs": (
        "need real logs: set DIFFDRIVE_MPC_DATA to a folder with norlab_husky_tile/ and norlab_warthog_terrains/ "
        "(NORLAB, BSD-3-Clause; see CONTRIBUTING.md)"
    ),
}
"""Reason for skipped tests in the last lines of a run, by mark."""
deselected_tests = pytest.StashKey[dict[str, int]]()


@cache
def is_installed(name):
    """Return True if a program is on the path or a shared library loads."""
    if ".so" not in name:
        return shutil.which(name) is not None
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def missing_packages(needs):
    """Return a line that names missing programs and their Debian packages; empty if none is missing."""
    required = {name: packages for need in needs for name, packages in SYSTEM_PACKAGES[need].items()}
    missing = {name: packages for name, packages in required.items() if not is_installed(name)}
    if not missing:
        return ""
    packages = " ".join(sorted({package for names in missing.values() for package in names.split()}))
    return f"not installed: {', '.join(missing)}; on Debian or Ubuntu: sudo apt-get install {packages}"


def pytest_configure(config):
    config.stash[deselected_tests] = dict.fromkeys(SKIP_REASONS, 0)
    if LOGS is not None and not Path(LOGS).is_dir():
        raise pytest.UsageError(f"DIFFDRIVE_MPC_DATA: no folder {LOGS!r}; unset it, or name the folder of the logs")
    # Without this condition, each worker of xdist would fail with a traceback.
    if "system" in config.option.markexpr.replace("not system", "") and not hasattr(config, "workerinput"):
        line = missing_packages(SYSTEM_PACKAGES)
        if line:
            raise pytest.UsageError(f"the system suite cannot run: {line}")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    if LOGS is None:
        missing = [item for item in items if item.get_closest_marker("real_logs") is not None]
        config.hook.pytest_deselected(items=missing)
        items[:] = [item for item in items if item not in missing]
    for item in items:
        if "ros_types" in item.fixturenames:
            item.add_marker(pytest.mark.system("compiler"))
    items.sort(key=lambda item: item.path.stem.removeprefix("test_") not in LONG_TESTS)


def pytest_runtest_setup(item):
    marker = item.get_closest_marker("system")
    line = marker and missing_packages(marker.args)
    if line:
        pytest.fail(line, pytrace=False)


def pytest_deselected(items):
    for item in items:
        marks = [mark for mark in SKIP_REASONS if item.get_closest_marker(mark) is not None]
        if marks:
            # If the logs are missing, a long test of them counts as a test of logs.
            reason = "real_logs" if LOGS is None and "real_logs" in marks else marks[0]
            item.config.stash[deselected_tests][reason] += 1


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error):
    # Every worker of xdist collects all tests, and a crashed worker reports none.
    counts = node.config.stash[deselected_tests]
    for mark, count in getattr(node, "workeroutput", {}).get("deselected_tests", {}).items():
        counts[mark] = max(count, counts[mark])


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_sessionfinish(session):
    config = session.config
    if hasattr(config, "workeroutput"):
        config.workeroutput["deselected_tests"] = config.stash[deselected_tests]
    result = yield
    # Printed below pytest's last line.
    reporter = config.pluginmanager.getplugin("terminalreporter")
    for mark, count in config.stash[deselected_tests].items():
        if count and reporter:
            reporter.write_line(f"{count} more tests {SKIP_REASONS[mark]}")
    return result


@pytest.fixture
def one_process(monkeypatch):
    """Commands without a number of jobs use one process, because each additional process takes seconds to start."""
    from diffdrive_mpc.bench import runner

    monkeypatch.setattr(runner, "os", SimpleNamespace(**vars(os) | {"sched_getaffinity": lambda process: {0}}))


@pytest.fixture
def quick_search():
    """Short search for training drives, training of networks and fit of twins."""
    from quick_settings import quick_settings

    with quick_settings():
        yield


@pytest.fixture(scope="session")
def ros_types():
    """Make nav2_msgs, tf2_msgs and bond importable in this process and its children; return their folder.

    Import them inside tests. Types are compiled as C++, so a test that uses them is one of the system suite.
    """
    from ros_types.build import add_types

    return add_types()
