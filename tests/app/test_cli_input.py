"""Command line: faults, interruptions and exit codes; every help text has examples."""

import re
import signal
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from commands import invoke
from diffdrive_mpc import MissingPackageError, NotCompiledError
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.case import combinations
from diffdrive_mpc.bench.runner import NotReproducibleError
from diffdrive_mpc.bench.sweep import sweep_settings
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs.reading import read_log
from processes import run_command

COMMANDS = ["", "simulate", "bench", "sim-robot", "identify", "config show", "config check", "config schema"]
COMMANDS += ["models list", "models show", "models check"]

runner = CliRunner()


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example_and_fits_80_columns(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = invoke(app, *command.split(), "--help").stdout
    assert f"Example: diffdrive-mpc {command}".rstrip() in " ".join(text.split())
    assert not [line for line in text.splitlines() if len(line) > 80 or re.search(r"[<{]|default: \(|x>=", line)]


ROS = r"install diffdrive-mpc\[ros\], or source the setup file of ROS 2 Jazzy"


@pytest.mark.parametrize(
    ("package", "command", "remedy"),
    [("mujoco", "simulate", r"[^\n]*--plant model:ssm"), ("rclpy", "node", ROS), ("rclpy", "sim-robot", ROS)],
)
def test_missing_package_is_reported_in_one_line_with_the_remedy(package: str, command: str, remedy: str) -> None:
    result = run_command(command, without=package)
    assert result.returncode == 1
    assert re.fullmatch(rf"error: the package '{package}' is not installed; {remedy}\n", result.stderr)


@pytest.mark.parametrize("error_type", [NotCompiledError, NotReproducibleError, MissingPackageError])
def test_project_error_has_exit_code_1(error_type: type[Exception], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise error_type("no compiler;\n  get one")

    monkeypatch.setattr("diffdrive_mpc.app.model_report.print_models", fail)
    result = runner.invoke(app, ["models", "list"])
    assert (result.exit_code, result.stderr) == (1, "error: no compiler; get one\n")


def test_grid_is_counted_before_it_is_listed() -> None:
    """Check a grid of 10^12 combinations of four settings, and a grid of four dimensions."""
    tracemalloc.start()
    values = ",".join(map(str, range(1, 1001)))
    with pytest.raises(ValueError, match="1,000,000,000,000 runs are requested, the limit is 100,000"):
        sweep_settings([f"weights.{name}={values}" for name in ("along", "across", "heading", "v")])
    names = [str(i) for i in range(1000)]
    with pytest.raises(ValueError, match="1,000,000,000,000 runs"):
        combinations(model=names, trajectory=names, surface=names, seed=range(1000))
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
    assert len(combinations(seed=range(5), model=["a", "b"])) == 10


def test_log_with_a_pause_of_years_is_not_filled_with_samples(tmp_path: Path) -> None:
    """The mapping permits any gap, so 5,000,000,300 samples would need 37 GiB for the first array."""
    log, mapping = tmp_path / "years.csv", tmp_path / "any.yaml"
    rows = [(0.02 * i, (-1) ** (i // 50) * 0.3) for i in range(300)]
    rows += [(1e8 + t, v) for t, v in rows]
    log.write_text("t,v,w,m\n" + "".join(f"{t:.2f},{v},{-v},{0.9 * v}\n" for t, v in rows), encoding="utf-8")
    columns = "time: t, command: {v: v, omega: w}, encoders: {v: m, omega: w}"
    mapping.write_text(f"gap: 1.0e+9\ncolumns: {{{columns}}}\n", encoding="utf-8")
    tracemalloc.start()
    with pytest.raises(ConfigError, match="more than 2,000,000 samples; give a shorter 'gap'"):
        read_log(log, mapping)
    assert tracemalloc.get_traced_memory()[1] < 100e6  # a block of text is 16 MB
    tracemalloc.stop()
    mapping.write_text(f"columns: {{{columns}}}\n", encoding="utf-8")
    assert len(read_log(log, mapping).records) == 2


@pytest.mark.parametrize("error_type", [KeyboardInterrupt, typer.Abort])
def test_interrupted_command_prints_one_error_line(
    error_type: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise error_type

    monkeypatch.setattr("diffdrive_mpc.app.model_report.print_model", interrupt)
    result = invoke(app, "models", "show", "ssm", code=130)
    assert result.stderr.strip() == "error: aborted"
    assert result.stdout == ""


@pytest.mark.parametrize("jobs", [pytest.param("1", marks=pytest.mark.system), "2"])
def test_sigterm_leaves_no_draft_and_no_process(jobs: str, tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from diffdrive_mpc.app.cli import main; main()", "bench", "--seeds", "20"]
    arguments = ["--models", "ssm,sm", "--trajectories", "circle,s", "--jobs", jobs, "--out", str(tmp_path / "out")]
    with subprocess.Popen([*command, *arguments], stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        session = process.pid
        while not list(tmp_path.rglob("*")):
            assert process.poll() is None
            time.sleep(0.05)
        time.sleep(2.0)
        process.send_signal(signal.SIGTERM)
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == 143
    assert stderr.strip() == "error: ended by SIGTERM"
    assert not list(tmp_path.rglob("*"))
    for _ in range(100):  # killed processes end after a short time; idle processes would remain for two minutes
        if session not in sessions():
            return
        time.sleep(0.1)
    raise AssertionError("processes still run")


def sessions() -> list[int]:
    """List the session of each process."""
    ids = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            ids.append(int(stat.read_text().rpartition(")")[2].split()[3]))
        except (FileNotFoundError, ProcessLookupError):
            continue
    return ids
