"""Registered parts, commands of the command line, and the compiled library of free space in the wheel."""

import json
import re
import shlex
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

from commands import invoke, refusal
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.command_line.options import PluggedCommand
from diffdrive_mpc.models.compiled.cache import CACHE_VARIABLE
from diffdrive_mpc.models.plug_ins import known_packages, plug_in
from diffdrive_mpc_extras.free_space.pieces import packaged_libraries


def test_wheel_contains_compiled_free_space(tmp_path):
    """An editable installation compiles free space at first use, so it fails without a compiler."""
    origin = json.loads(distribution(PACKAGE).read_text("direct_url.json") or "{}")
    is_editable = bool(origin.get("dir_info", {}).get("editable"))
    load = "from diffdrive_mpc_extras.free_space.pieces import load_free_space; load_free_space()"
    environment = {"PATH": str(tmp_path), CACHE_VARIABLE: str(tmp_path)}
    process = subprocess.run([sys.executable, "-c", load], env=environment, capture_output=True, text=True, check=False)
    assert any(packaged_libraries()) != is_editable
    assert ("NotCompiledError" in process.stderr, process.returncode != 0) == (is_editable, is_editable)


PACKAGE = "diffdrive-mpc-extras"
COMMANDS = sorted(name for name, package in known_packages()["commands"].items() if package == PACKAGE)
README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
LIST_MODULES = """
import sys
sys.argv[1:] = {words}
from diffdrive_mpc.app.cli import main
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
print(*sorted(name for name in sys.modules if name.startswith("diffdrive_mpc_extras.")), sep="\\n")
print(*(name for name in ("casadi", "scipy", "pandas", "mujoco", "matplotlib") if name in sys.modules), sep="\\n")
"""


def modules_loaded_by(*arguments: str) -> list[str]:
    process = subprocess.run(
        [sys.executable, "-c", LIST_MODULES.format(words=list(arguments))], capture_output=True, text=True, check=True
    )
    return [line for line in process.stdout.splitlines() if re.fullmatch(r"[a-z_0-9.]+", line)]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_registered_and_has_help_with_an_example(name: str) -> None:
    assert isinstance(plug_in("commands", name), PluggedCommand)
    arguments = name.split(".")
    help_text = " ".join(invoke(app, *arguments, "--help").stdout.split())
    assert f"Example: diffdrive-mpc {' '.join(arguments)} " in help_text


def test_overview_lists_all_commands_and_loads_command_modules_only() -> None:
    overview = invoke(app, "--help").stdout
    assert all(f"  {name} " in overview for name in COMMANDS if "." not in name)
    assert all(name.endswith(".command") or name.count(".") == 1 for name in modules_loaded_by("--help"))


def test_help_of_a_command_loads_only_this_command() -> None:
    assert [name for name in modules_loaded_by("twin", "--help") if name.endswith(".command")] == [
        "diffdrive_mpc_extras.twin.command"
    ]
    assert not [name for name in modules_loaded_by("config", "schema", "weights") if name.endswith(".command")]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("export --out {out} --trajectories cirle", "unknown trajectory 'cirle'"),
        ("export --out {existing}", "--out {existing}"),
        ("export --out {out} --precision half", "--precision 'half': give double or float"),
        ("export --out {out} --set solver.method=osqp", "an exported controller has neither OSQP nor DAQP"),
        ("excite --out {out}.yaml --for model", "needs --inside"),
        ("excite --out {out}.yaml --side -1", "--side -1.0: give a positive number"),
        ("rehearse --out {out} --controller pursuit", "No such option: --controller"),
        ("repeat missing.yaml --out {out}", "missing.yaml"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line_with_exit_code_2(
    arguments: str, message: str, tmp_path: Path
) -> None:
    out, existing = tmp_path / "out", tmp_path / "existing"
    existing.write_text("a file")
    assert message.format(existing=existing) in refusal(*shlex.split(arguments.format(out=out, existing=existing)))
    assert not out.exists()


@pytest.mark.long
@pytest.mark.usefixtures("one_process", "quick_search")
def test_every_command_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```(\w+)\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    for body in [body for language, body in blocks if language == "yaml"]:
        (tmp_path / body.split()[2]).write_text(body, encoding="utf-8")
    lines = [line for language, body in blocks if language == "sh" for line in body.splitlines()]
    for line in lines:
        arguments = shlex.split(line)
        if arguments[0] == "diffdrive-mpc":
            invoke(app, *arguments[1:])
