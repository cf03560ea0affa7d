"""The first hour of a new user: a new robot, its log, and every step up to the drive over DDS.

The robot is not one of this project: 3 m/s, logged at 20 Hz in columns with other names, and its body turns 0.7 times
as fast as its wheels indicate. It is simulated in this file in a few lines, independent of the plants of `sim`.
"""

import re
import shlex

import numpy as np
import pytest
from typer.testing import CliRunner

from diffdrive_mpc import load_config
from diffdrive_mpc.app.cli import app

pytestmark = pytest.mark.system

PERIOD, TRUTH_STEP = 0.05, 0.005
DEAD_TIME, LAG_V, LAG_OMEGA, YAW_GAIN = 0.12, 0.22, 0.18, 0.7
TOP_SPEED = 3.0
HEADER = "stamp_ms,speed_cmd,turn_cmd,wheel_speed,wheel_turn,gyro_z,east,north,yaw_deg"


def write_log(path, duration=150.0):
    """Write the log of a drive with steps of the command; the robot has a dead time and first-order lags."""
    random = np.random.default_rng(11)
    rows = round(duration / PERIOD)
    commands, row = np.zeros((rows, 2)), 20
    while row < rows:
        length = random.integers(15, 50)
        commands[row : row + length] = random.uniform(-0.5, TOP_SPEED), random.uniform(-1.5, 1.5)
        row += length
    steps = round(PERIOD / TRUTH_STEP)
    late = round(DEAD_TIME / TRUTH_STEP)
    applied = np.vstack([np.zeros((late, 2)), np.repeat(commands, steps, axis=0)])
    v = omega = x = y = theta = 0.0
    lines = [HEADER]
    for step in range(rows * steps):
        if step % steps == 0:
            noise = random.normal(0.0, [0.01, 0.02, 0.01, 0.005, 0.005, 0.2])
            readings = np.array([v, omega / YAW_GAIN, omega, x, y, np.degrees(theta)]) + noise
            stamp = 5.0e6 + 1e3 * step * TRUTH_STEP
            lines.append(",".join(f"{value:.6g}" for value in (*commands[step // steps], *readings)))
            lines[-1] = f"{stamp:.1f},{lines[-1]}"
        v += TRUTH_STEP * (applied[step, 0] - v) / LAG_V
        omega += TRUTH_STEP * (YAW_GAIN * applied[step, 1] - omega) / LAG_OMEGA
        theta += TRUTH_STEP * omega
        x += TRUTH_STEP * v * np.cos(theta)
        y += TRUTH_STEP * v * np.sin(theta)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def run_line(line):
    """Run a command line that has to succeed; return its output."""
    result = CliRunner().invoke(app, shlex.split(line)[1:], prog_name="diffdrive-mpc")
    assert result.exit_code == 0, f"{line}: {result.output}"
    return result.output


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Folder of the user after `identify` with a drafted mapping, which needs no correction, and the output."""
    folder = tmp_path_factory.mktemp("user")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_log(folder / "drive.csv")
        run_line("diffdrive-mpc identify --draft-mapping drive.csv")
        yield folder, run_line("diffdrive-mpc identify drive.csv --mapping mapping.yaml --out mine")


def position_rmse(output):
    """Read the position RMSE [m] from the output of `identify` or `simulate`."""
    value, unit = re.search(r"position RMSE (\d+\.\d+) (mm|m)\b", output).groups()
    return float(value) * {"mm": 1e-3, "m": 1.0}[unit]


def test_identified_configuration_matches_the_robot(session):
    config = load_config(session[0] / "mine" / "config.yaml")
    assert config.sample_time == PERIOD
    assert config.limits.v == pytest.approx(TOP_SPEED, rel=0.01)
    match = re.search(r"omega becomes (\S+) times its command, (\S+) s later", session[1])
    assert float(match[1]) == pytest.approx(YAW_GAIN, rel=0.01)
    assert float(match[2]) == pytest.approx(DEAD_TIME + LAG_OMEGA, abs=0.01)


def test_suggested_command_reproduces_the_figure_of_the_table(session):
    output = session[1]
    command = output[output.rindex("diffdrive-mpc simulate") :].replace("\\\n", " ")
    (promised,) = re.findall(r"model itself +circle +(\S+)", output)
    assert position_rmse(run_line(command)) == pytest.approx(float(promised), abs=0.0001)


def test_path_at_the_speed_of_the_robot_is_driven(session):
    (session[0] / "fast.yaml").write_text("segments:\n- {v: 2.8, omega: 0.3, duration: 6.0}\n", encoding="utf-8")
    options = "--config mine/config.yaml --plant model:mine/model.yaml --surface mine/surface.yaml"
    assert position_rmse(run_line(f"diffdrive-mpc simulate {options} --trajectory fast.yaml")) < 0.05
