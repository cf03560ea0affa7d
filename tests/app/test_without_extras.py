"""With `extras` taken out everything else works, without what it brings."""

import subprocess
import sys

WITHOUT = """
import sys

class Gone:
    def find_spec(self, name, path, target=None):
        if name.startswith("diffdrive_mpc.extras"):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)

sys.meta_path.insert(0, Gone())
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


def test_a_command_that_is_gone_is_no_command(tmp_path):
    said = run(tmp_path, "plan", "--from", "0,0,0", "--to", "1,0,0", "--out", "plan")
    assert said.returncode == 2 and "No such command 'plan'" in said.stderr
    assert "torque" not in run(tmp_path, "--help").stdout


def test_a_model_that_is_gone_is_one_line(tmp_path):
    said = run(tmp_path, "simulate", "--model", "lstm")
    assert said.returncode == 2 and "unknown model 'lstm'" in said.stderr and said.stderr.count("\n") == 1


def test_a_drive_is_driven_and_identified(tmp_path):
    driven = run(tmp_path, "simulate", "--trajectory", "s", "--log", "s.csv")
    assert driven.returncode == 0, driven.stderr
    found = run(tmp_path, "identify", "s.csv", "--structure", "sm", "--out", "found")
    assert found.returncode == 0, found.stderr
    assert (tmp_path / "found" / "report.html").is_file()


def test_a_bench_needs_none(tmp_path):
    words = ("--models", "sm", "--trajectories", "circle", "--seeds", "1", "--out", "bench")
    assert run(tmp_path, "bench", *words).returncode == 0


def test_json_schema_of_models_leaves_out_missing_structures(tmp_path):
    schema = run(tmp_path, "config", "schema", "model", "--json").stdout
    assert '"ssm"' in schema and '"lstm"' not in schema
