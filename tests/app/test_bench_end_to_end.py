"""Commands as a user runs them, on the mujoco plant."""

import json
import re
from pathlib import Path

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.report_folder import CONTENTS


def test_quick_bench_writes_its_report(tmp_path: Path) -> None:
    arguments = "--quick --models ssm --trajectories cane --jobs 1 --controller mpc,kanayama"
    result = invoke(app, "bench", "--out", tmp_path / "out", *arguments.split())
    files = [CONTENTS, "bench.json", "bench.md", "figures", "report.html"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == files
    report = json.loads((tmp_path / "out" / "bench.json").read_text())
    mpc, peer = report["runs"]
    assert (mpc["controller"], mpc["plant"], peer["controller"]) == ("mpc", "mujoco", "kanayama")
    assert mpc["completed"] and peer["completed"]
    assert mpc["in_band_percent"] == 100.0
    assert mpc["fallbacks"] == 0
    # The output ends with models and errors on one screen of 80 columns, also in a pipe, and the path of the report.
    lines = result.stdout.rstrip().splitlines()
    assert lines[-1] == f"2 runs in {report['meta']['wall_time_s']:g} s; report: {tmp_path / 'out' / 'report.html'}"
    table = lines[lines.index(next(line for line in lines if line.startswith("Tracking error"))) :]
    assert len(table) <= 24 and all(len(line) <= 80 for line in table[:-1])
    assert [line.split()[0] for line in table[3:5]] == ["SSM", "kanayama"]
    # The figures show the predictive controller, whichever controller is best.
    figures = {path.stem for path in (tmp_path / "out" / "figures").iterdir()}
    assert figures == {"overview", "step-time", "ssm-cane"}


TIPPING = "description: tips\npushes: [{force: 200.0, direction: 1.5708, height: 0.4, start: 1.0, duration: 1.0}]\n"
TIPPED = r"t = 1\.\d\d s: the robot has tipped over; lower the force, height or payload of the scenario"


def test_tipped_robot_is_an_incomplete_run_and_the_bench_continues(tmp_path: Path) -> None:
    (tmp_path / "tips.yaml").write_text(TIPPING)
    out, scenarios = tmp_path / "out", f"{tmp_path / 'tips.yaml'},none"
    arguments = "--quick --models ssm --trajectories cane --jobs 1 --scenario"
    result = invoke(app, "bench", "--out", out, *arguments.split(), scenarios, code=1)
    first = r"1 of 2 runs of mpc did not complete, the first: ssm on cane, horizon 30, seed 0, scenario tips"
    # A slow machine also prints the progress.
    assert re.fullmatch(rf"error: {first} \({TIPPED}\); bench.json lists them", result.stderr.splitlines()[-1])
    tipped, upright = json.loads((out / "bench.json").read_text())["runs"]
    assert (tipped["completed"], upright["completed"]) == (False, True)
    assert re.fullmatch(TIPPED, tipped["ended"])
    assert upright["ended"] is None
    assert 50 < tipped["steps"] < 100 < upright["steps"]
    # On a busy machine, a short run may have no tick with undisturbed timing.
    timing_prefixes = ("step_time", "solve_time")
    undefined = {name for name, value in tipped.items() if value is None and not name.startswith(timing_prefixes)}
    assert undefined == {"recovery_time_s"}
