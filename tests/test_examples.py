"""Examples run unchanged in any folder, with the documented results."""

import re
import runpy
import signal
import subprocess
import sys
import time
from contextlib import chdir, redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
MAX_LINES = 60
RUN = re.compile(r"position \[m\] +(0\.\d+).*steps, completed; in the band 100\.0 %", re.DOTALL)


def run(name, folder):
    """Run an example in this process, which saves its imports."""
    with chdir(folder), redirect_stdout(StringIO()) as output:
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return output.getvalue()


def test_every_example_is_tested():
    tested = set(re.findall(r"\w+\.py", Path(__file__).read_text(encoding="utf-8")))
    assert {path.name for path in EXAMPLES.glob("*.py")} <= tested


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_example_is_short(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) < MAX_LINES


def test_circle_example_tracks_a_circle(tmp_path):
    output = run("track_a_circle.py", tmp_path)
    assert float(RUN.search(output)[1]) < 0.01
    assert "solver methods: {" in output


def test_identification_example_improves_the_tracking(tmp_path):
    shipped, identified = map(float, re.findall(r"position RMSE (\S+) mm", run("identify_and_drive.py", tmp_path)))
    assert identified < 0.75 * shipped
    assert (tmp_path / "identified" / "model.yaml").exists()


def test_plant_example_tracks(tmp_path):
    assert float(RUN.search(run("own_plant.py", tmp_path))[1]) < 0.015


def test_narrow_places_example_waits_and_arrives(tmp_path):
    output = run("narrow_places.py", tmp_path)
    assert "waits for disc 0, which crosses the path" in output
    assert abs(float(re.search(r"at x = (\S+) m", output)[1]) - 8.0) < 0.05
    assert (tmp_path / "narrow-places.png").stat().st_size > 10_000


def test_loop_example_reaches_the_end_without_ros(tmp_path, monkeypatch):
    """Only `sleep` advances this clock; the interrupted loop below uses the real clock."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(time, "sleep", lambda seconds: now.append(now.pop() + seconds))
    x, y = map(float, re.search(r"x = (\S+) m, y = (\S+) m", run("loop_without_ros.py", tmp_path)).groups())
    # End of the cane according to its wheels and gyro.
    assert abs(x - 2.0) < 0.03 and abs(y - 1.43) < 0.03


def test_interrupted_loop_example_sends_zero_last(tmp_path):
    command = [sys.executable, "-u", str(EXAMPLES / "loop_without_ros.py")]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        # In background test runs the signal is ignored, and child processes inherit this setting.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509 - the child has no threads
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "driving\n"
        time.sleep(0.4)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert "interrupted" in output
    assert re.search(r"last command \(0\.0, 0\.0\), at x = 0\.\d+ m", output)


def test_cost_example_increases_the_distance(tmp_path):
    without, with_cost = map(float, re.findall(r"(0\.\d+) m", run("own_cost.py", tmp_path)))
    assert without < 0.1
    assert with_cost > 0.35


def test_path_example_ends_at_the_stated_point(tmp_path):
    output = run("own_path.py", tmp_path)
    assert [float(error) < 4.0 for error in re.findall(r"RMSE (\S+) mm, completed: True", output)] == [True, True]
    assert "ends at x = 5.00 m, y = 2.00 m" in output


def test_osqp_example_agrees_with_active_limits(tmp_path):
    active, difference = re.search(r"to (\d+) active .* command (\S+)", run("osqp_directly.py", tmp_path)).groups()
    assert int(active) > 0
    assert float(difference) < 1e-9


def test_horizon_sweep_example_finds_a_sufficient_horizon(tmp_path):
    output = run("horizon_sweep.py", tmp_path)
    errors = {int(row[0]): float(row[1]) for row in map(str.split, output.splitlines()[2:6])}
    assert errors[5] > 1.5 * errors[20]
    assert "sufficient: horizon 20" in output


def test_structure_example_fits_the_acceleration_limits(tmp_path):
    output = run("own_structure.py", tmp_path)
    limits = re.search(r"limit (\S+) m/s\^2, (\S+) rad/s\^2", output).groups()
    assert [float(limit) for limit in limits] == pytest.approx([0.3, 1.5], rel=0.03)
    shipped, fitted = map(float, re.findall(r"RMSE (\S+) mm", output))
    assert fitted < 0.5 * shipped


def test_gymnasium_example_tracks(tmp_path):
    output = run("gymnasium_loop.py", tmp_path)
    assert "lost: False" in output
    assert float(re.search(r"RMSE (\S+) mm", output)[1]) < 20
