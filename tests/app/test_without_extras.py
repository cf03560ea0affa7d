"""The root package works without the other packages; a command of a missing package gives one line."""

import subprocess
import sys

import pytest

PROGRAM = """
import sys
from importlib import metadata

class Gone:
    def find_spec(self, name, path, target=None):
        if name.startswith(("diffdrive_mpc_extras", "diffdrive_mpc_monitor", "diffdrive_mpc_lab")):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)

sys.meta_path.insert(0, Gone())
metadata.entry_points = lambda **chosen: ()
from diffdrive_mpc.app.cli import main
sys.argv[1:] = WORDS
main()
"""


def run(folder, *arguments):
    program = PROGRAM.replace("WORDS", repr([str(word) for word in arguments]))
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=folder, check=False)


def test_remaining_models_are_listed(tmp_path):
    listed = run(tmp_path, "models", "list").stdout
    assert all(name in listed for name in ("mbm", "sm", "ssm", "kinematic"))
    assert "lstm" not in listed and "p2_physical" not in listed


@pytest.mark.parametrize(
    ("arguments", "subject", "package"),
    [
        (("plan", "--from", "0,0,0"), "command 'plan'", "extras"),
        (("models", "compare", "drive.csv"), "command 'models compare'", "extras"),
        (("log", "replay", "drive.mcap"), "command 'log replay'", "extras"),
        (("monitor", "--ros-args"), "command 'monitor'", "monitor"),
        (("identify", "drive.csv", "--for", "nav2"), "parameter writer 'nav2'", "extras"),
        (("simulate", "--model", "lstm"), "model 'lstm'", "extras"),
    ],
)
def test_part_of_a_missing_package_gives_one_line_with_the_remedy(tmp_path, arguments, subject, package):
    result = run(tmp_path, *arguments)
    line = f"error: {subject} is in the package diffdrive-mpc-{package}: pip install 'diffdrive-mpc[{package}]'\n"
    assert (result.returncode, result.stderr) == (1, line)


def test_command_of_a_damaged_package_gives_one_line_with_the_remedy(tmp_path):
    program = PROGRAM.replace("metadata.entry_points = lambda **chosen: ()\n", "").replace("WORDS", "['plan']")
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path, check=False)
    line = "error: No module named 'diffdrive_mpc_extras'; install the package of this command again\n"
    assert (result.returncode, result.stderr) == (1, line)


@pytest.mark.system
def test_root_package_drives_and_identifies(tmp_path):
    drive = run(tmp_path, "simulate", "--trajectory", "s", "--log", "s.csv")
    assert drive.returncode == 0, drive.stderr
    identification = run(tmp_path, "identify", "s.csv", "--structure", "sm", "--out", "found")
    assert identification.returncode == 0, identification.stderr
    assert (tmp_path / "found" / "report.html").is_file()


def test_json_schema_of_models_omits_missing_structures(tmp_path):
    schema = run(tmp_path, "config", "schema", "model", "--json").stdout
    assert '"ssm"' in schema and '"lstm"' not in schema
