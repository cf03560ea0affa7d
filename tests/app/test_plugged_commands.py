"""Commands of packages and former names, with packages that are made up."""

from importlib.metadata import EntryPoint

import pytest

from commands import invoke
from diffdrive_mpc.app.cli import command_line
from diffdrive_mpc.models import plug_ins

COMMAND = """
from diffdrive_mpc.app.command_line.options import PluggedCommand

def greet(*, name: str = "all") -> None:
    \"\"\"Print a greeting; nothing else.\"\"\"
    print(f"hello {name}")

GREET = PluggedCommand("Drive", greet, "Example: diffdrive-mpc greet --name you")
"""


@pytest.fixture
def registered(tmp_path, monkeypatch):
    """Register entry points `name = place` as the only commands of packages."""
    (tmp_path / "greeting.py").write_text(COMMAND)
    (tmp_path / "broken.py").write_text("raise ImportError('broken needs diffdrive-mpc 9.9')\n")
    monkeypatch.syspath_prepend(tmp_path)

    def register(**places):
        entries = [EntryPoint(name, place, "diffdrive_mpc.commands") for name, place in places.items()]
        monkeypatch.setattr(plug_ins, "entry_points", lambda group: entries if group.endswith("commands") else [])
        plug_ins._entries.cache_clear()
        plug_ins.plug_in.cache_clear()

    yield register
    plug_ins._entries.cache_clear()
    plug_ins.plug_in.cache_clear()


def test_registered_command_is_listed_and_runs(registered):
    registered(greet="greeting:GREET")
    assert "greet     Print a greeting; nothing else." in invoke(command_line(), "--help").stdout
    assert invoke(command_line(["greet"]), "greet", "--name", "you").stdout == "hello you\n"


def test_broken_package_leaves_other_commands_usable(registered):
    registered(greet="broken:GREET")
    assert "Not available" in invoke(command_line(), "--help").stdout
    assert "broken needs diffdrive-mpc 9.9" in invoke(command_line(["greet"]), "greet", code=1).stderr
    assert invoke(command_line(["models"]), "models", "list").exit_code == 0


def test_plug_in_of_another_command_is_not_imported(registered):
    registered(greet="broken:GREET")
    names = [command.name for command in command_line(["bench"]).registered_commands]
    assert names == ["bench"]
