"""The monitor shares no code with the controller: looked for in its sources, and in the process that runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from imports import imported

ROOT = Path(__file__).parents[2]
ROOM = ROOT / "mpc" / "monitor"
HELPERS = {
    "models.checked_yaml",
    "models.compiled",
    "models.errors",
    "models.file_limits",
    "models.input_file",
    "models.named_file",
    "models.table",
    "models.suggestions",
    "models.trust",
}
"""What it has of `models`: readers of files, and what loads C. Nothing here moves a robot."""
HEAVY = ("casadi", "mujoco", "osqp", "daqp", "scipy", "control", "matplotlib", "pandas")


def ours(name):
    """Name within our package, or None."""
    return name.removeprefix("diffdrive_mpc.") if name.startswith("diffdrive_mpc.") else None


def allowed(name):
    return name.startswith(("mpc.monitor",)) or any(name == one or name.startswith(f"{one}.") for one in HELPERS)


def test_its_python_imports_nothing_of_the_controller():
    looked_at = 0
    for path in ROOM.rglob("*.py"):
        modules = {module for module, _ in imported(path)}
        assert not any(module.startswith(".") for module in modules), path
        names = [ours(module) for module in modules if module.startswith("diffdrive_mpc")]
        assert all(name and allowed(name) for name in names), (path, names)
        looked_at += len(names)
    assert looked_at > 10


def test_its_c_includes_nothing_of_the_controller():
    standard = {"math.h", "string.h", "stdio.h", "stdint.h"}
    found = set()
    for path in [*ROOM.rglob("*.c"), *ROOM.rglob("*.h")]:
        found |= set(re.findall(r'#\s*include\s*[<"]([^>"]+)', path.read_text(encoding="utf-8")))
    assert found - standard == {"judge.h", "rules.h"}
    assert "ddmpc_" not in (ROOM / "core" / "judge.c").read_text(encoding="utf-8")


def test_the_controller_knows_nothing_of_it():
    for path in (ROOT / "mpc").rglob("*"):
        if path.suffix in (".py", ".c", ".h") and not path.is_relative_to(ROOM):
            text = path.read_text(encoding="utf-8")
            assert "mpc.monitor." not in text and "judge.h" not in text, path


@pytest.mark.parametrize("what", ["judge", "process"])
def test_what_runs_has_none_of_it_loaded(what):
    """The whole command, up to where it would wait for messages."""
    code = {
        "judge": "from diffdrive_mpc.mpc.monitor.judge import Judge\n"
        "from diffdrive_mpc.mpc.monitor.rules import load_rules\n"
        "Judge(load_rules()).command(0.0, 0.0, 1.0, 0.0)\n",
        "process": "import sys\n"
        "from rclpy.executors import SingleThreadedExecutor\n"
        "def end(self, timeout_sec=None): raise KeyboardInterrupt\n"
        "SingleThreadedExecutor.spin_once = end\n"
        "from diffdrive_mpc.app.cli import main\n"
        "sys.argv = ['diffdrive-mpc', 'monitor']\n"
        "try: main()\n"
        "except (SystemExit, KeyboardInterrupt): pass\n",
    }[what]
    code += "import sys\nprint(*sorted(sys.modules), sep='\\n')\n"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    loaded = set(result.stdout.split())
    assert "diffdrive_mpc.mpc.monitor.judge" in loaded
    if what == "process":
        assert "diffdrive_mpc.mpc.monitor.ros.node" in loaded, result.stderr
    found = {name for name in map(ours, loaded) if name and name.startswith(("mpc.", "models.", "sim."))}
    assert {name for name in found if not allowed(name)} == set()
    assert {name for name in HEAVY if name in loaded} == set()
