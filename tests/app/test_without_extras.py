"""Without the other packages the root package works; a command of a missing package is one line."""

import subprocess
import sys

import pytest

WITHOUT = """
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


def run(folder, *words):
    program = WITHOUT.replace("WORDS", repr([str(word) for word in words]))
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=folder, check=False)


def test_the_models_that_are_left_are_listed(tmp_path):
    listed = run(tmp_path, "models", "list").stdout
    assert all(name in listed for name in ("mbm", "sm", "ssm", "kinematic"))
    assert "lstm" not in listed and "p2_physical" not in listed


@pytest.mark.parametrize(
    ("words", "package", "extra"),
    [
        (("plan", "--from", "0,0,0"), "diffdrive-mpc-extras", "extras"),
        (("models", "compare", "drive.csv"), "diffdrive-mpc-extras", "extras"),
        (("monitor", "--ros-args"), "diffdrive-mpc-monitor", "monitor"),
    ],
)
def test_command_of_a_missing_package_is_one_line_with_the_remedy(tmp_path, words, package, extra):
    done = run(tmp_path, *words)
    name = " ".join(words[:2] if words[0] == "models" else words[:1])
    line = f"error: command '{name}' is in the package {package}: pip install 'diffdrive-mpc[{extra}]'\n"
    assert (done.returncode, done.stderr) == (1, line)


def test_parameters_of_another_package_need_the_plug_in(tmp_path):
    done = run(tmp_path, "identify", "drive.csv", "--for", "nav2")
    line = (
        "error: parameter writer 'nav2' is in the package diffdrive-mpc-extras: pip install 'diffdrive-mpc[extras]'\n"
    )
    assert (done.returncode, done.stderr) == (1, line)


@pytest.mark.parametrize(
    "words", [("simulate", "--model", "lstm"), ("config", "show", "lstm"), ("models", "show", "lstm")]
)
def test_model_of_a_missing_package_is_one_line_with_the_remedy(tmp_path, words):
    done = run(tmp_path, *words)
    line = "error: model 'lstm' is in the package diffdrive-mpc-extras: pip install 'diffdrive-mpc[extras]'\n"
    assert (done.returncode, done.stderr) == (1, line)


def test_a_drive_is_driven_and_identified(tmp_path):
    driven = run(tmp_path, "simulate", "--trajectory", "s", "--log", "s.csv")
    assert driven.returncode == 0, driven.stderr
    found = run(tmp_path, "identify", "s.csv", "--structure", "sm", "--out", "found")
    assert found.returncode == 0, found.stderr
    assert (tmp_path / "found" / "report.html").is_file()


def test_json_schema_of_models_leaves_out_missing_structures(tmp_path):
    schema = run(tmp_path, "config", "schema", "model", "--json").stdout
    assert '"ssm"' in schema and '"lstm"' not in schema
