"""Checks of logs: each fault gives a finding with its position, and a correct log has no findings."""

import numpy as np
import pytest
from log_parts import drive, write_csv, write_mapping

from diffdrive_mpc import ConfigError, Controller, load_config, load_trajectory
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.diagnosis import summary
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc.sim.log_csv import write_rows

COLUMNS = drive()


def read_modified(tmp_path, changes, mask=None):
    columns = {name: np.array(value) for name, value in (COLUMNS | changes).items()}
    if mask is not None:
        columns = {name: value[mask] for name, value in columns.items()}
    return read_log(write_csv(tmp_path / "log.csv", columns), write_mapping(tmp_path / "map.yaml"))


def texts(log, kind):
    return [str(finding) for finding in log.findings if finding.kind == kind]


def with_value(name, rows, value):
    column = COLUMNS[name].copy()
    column[rows] = value
    return {name: column}


def test_correct_log_has_no_findings(tmp_path):
    assert read_modified(tmp_path, {}).findings == ()


def test_gap_ends_the_stretch(tmp_path):
    mask = (COLUMNS["t"] < 5.0) | (COLUMNS["t"] > 7.0)
    log = read_modified(tmp_path, {}, mask)
    assert texts(log, "gap") == ["log.csv, 5.0 to 7.0 s: no data for 2.040 s; a new stretch starts"]
    assert [round(record.start, 2) for record in log.records] == [0.0, 7.02]
    assert sum(len(record.command) for record in log.records) == mask.sum()


def test_no_command_is_held_across_a_gap(tmp_path):
    """Commands are logged only when they change, so the command after a gap is unknown until the next command."""
    is_logged = np.arange(1000) % 25 == 0
    columns = {name: np.where(is_logged, COLUMNS[name], np.nan) for name in ("v_ref", "omega_ref")}
    mask = (COLUMNS["t"] < 5.0) | (COLUMNS["t"] > 7.1)
    path = write_csv(tmp_path / "log.csv", {name: value[mask] for name, value in (COLUMNS | columns).items()})
    path.write_text(path.read_text().replace("nan", ""))
    log = read_log(path, write_mapping(tmp_path / "map.yaml"))
    first, second = log.records
    assert np.array_equal(first.command[:, 0], COLUMNS["v_ref"][:250])
    assert second.start == pytest.approx(7.5)
    assert np.array_equal(second.command[:, 0], COLUMNS["v_ref"][375:])


def test_jitter_is_measured(tmp_path):
    rng = np.random.default_rng(1)
    log = read_modified(tmp_path, {"t": COLUMNS["t"] + rng.uniform(0, 0.012, 1000)})
    assert "dead times are uncertain" in texts(log, "jitter")[0]
    assert texts(read_modified(tmp_path, {"t": COLUMNS["t"] + rng.uniform(0, 0.003, 1000)}), "jitter") == []


def test_time_that_runs_backwards_starts_a_new_stretch(tmp_path):
    log = read_modified(tmp_path, {"t": np.where(np.arange(1000) < 600, COLUMNS["t"], COLUMNS["t"] - 12.0)})
    assert texts(log, "time backwards") == [
        "log.csv, line 602: time goes backwards by 11.980 s, to 0.000 s; a new stretch starts"
    ]
    assert [len(record.command) for record in log.records] == [600, 400]


def test_repeated_time_is_a_finding(tmp_path):
    log = read_modified(tmp_path, with_value("t", 500, COLUMNS["t"][499]))
    assert texts(log, "time stands still") == [
        "log.csv, line 502: 1 rows have the time of the row before; the last row of each time is used"
    ]


def test_nan_rows_of_a_sensor_are_omitted(tmp_path):
    log = read_modified(tmp_path, with_value("gyro", [100, 101, 300], np.nan))
    assert texts(log, "NaN rows") == [
        "log.csv, line 102 to 103, 302: column 'gyro' is not finite or beyond 1e+20 in 3 rows; these rows are left out"
    ]
    (record,) = log.records
    assert list(np.flatnonzero(~record.fresh_yaw_rate)) == [100, 101, 300]


def test_numbers_too_large_to_be_squared_are_not_readings(tmp_path):
    """The squares of these numbers would overflow."""
    log = read_modified(tmp_path, with_value("gyro", [100, 300], 1e308))
    assert "column 'gyro' is not finite or beyond 1e+20 in 2 rows" in texts(log, "NaN rows")[0]
    for value in (1e308, -1e308, np.nan):
        with pytest.raises(ConfigError, match="column 'v_ref' holds no usable number in any row"):
            read_modified(tmp_path, with_value("v_ref", slice(None), value))


def test_unknown_command_ends_the_stretch(tmp_path):
    log = read_modified(tmp_path, with_value("v_ref", 400, np.nan))
    assert "column 'v_ref' is not finite or beyond 1e+20 in 1 rows" in texts(log, "NaN rows")[0]
    assert [len(record.command) for record in log.records] == [400, 599]


def test_short_stretches_are_omitted(tmp_path):
    mask = (COLUMNS["t"] < 5.0) | ((COLUMNS["t"] > 6.0) & (COLUMNS["t"] < 6.2)) | (COLUMNS["t"] > 7.0)
    log = read_modified(tmp_path, {}, mask)
    assert texts(log, "short stretch") == ["log.csv, 6.0 to 6.2 s: 9 samples, fewer than 20; the stretch is left out"]
    assert len(log.records) == 2


@pytest.mark.parametrize(
    ("name", "sensor", "mask"), [("gyro", "gyro", "fresh_yaw_rate"), ("v", "encoders", "fresh_twist")]
)
def test_readings_of_a_stuck_sensor_are_omitted(tmp_path, name, sensor, mask):
    rows = slice(300, 500)
    changes = with_value(name, rows, COLUMNS[name][300])
    if sensor == "encoders":
        changes |= with_value("omega_wheels", rows, COLUMNS["omega_wheels"][300])
    log = read_modified(tmp_path, changes)
    message = f"the {sensor} repeated one reading for 4.0 s under commands to move; these readings are left out"
    assert texts(log, "stuck sensor") == [f"log.csv, 6.0 to 10.0 s: {message}"]
    fresh = getattr(log.records[0], mask)
    assert not fresh[301:500].any() and fresh[:301].all() and fresh[500:].all()


def test_sensors_of_a_robot_at_rest_are_not_stuck(tmp_path):
    rows = slice(300, 500)
    names = ("v_ref", "omega_ref", "v", "omega_wheels", "gyro")
    changes = {}
    for name in names:
        changes |= with_value(name, rows, 0.0)
    assert texts(read_modified(tmp_path, changes), "stuck sensor") == []


@pytest.mark.parametrize(("fraction", "count"), [(0.9, 1), (0.1, 0)])
def test_resting_wheels_are_stuck_only_for_a_large_command(tmp_path, fraction, count):
    """A small command may be within a dead band, which the model should contain."""
    rows = slice(300, 500)
    changes = with_value("v_ref", rows, fraction * np.abs(COLUMNS["v_ref"]).max()) | with_value("omega_ref", rows, 0.0)
    changes |= with_value("v", rows, 0.0) | with_value("omega_wheels", rows, 0.0)
    assert len(texts(read_modified(tmp_path, changes), "stuck sensor")) == count


@pytest.mark.parametrize(
    ("name", "reading"),
    [("v", "v of the encoders"), ("omega_wheels", "omega of the encoders"), ("gyro", "omega of the gyro")],
)
def test_wrong_sign_is_an_error(tmp_path, name, reading):
    log = read_modified(tmp_path, {name: -COLUMNS[name]})
    (message,) = texts(log, "wrong sign")
    assert message.startswith(f"log.csv: {reading} has the opposite sign to the command (correlation -")
    with pytest.raises(ConfigError, match="sign: -1"):
        log.require_sound()


@pytest.mark.parametrize("gain", [0.4, 1.0, 2.0])
def test_plausible_gains_give_no_finding(tmp_path, gain):
    log = read_modified(tmp_path, {"gyro": gain * COLUMNS["gyro"]})
    assert log.findings == ()


@pytest.mark.parametrize("count", [20, 35, 49])
def test_stretch_shorter_than_the_maximum_lag_has_no_error(tmp_path, count):
    """The maximum lag of 1 s is 50 samples: a shorter stretch does not determine lag or sign."""
    log = read_modified(tmp_path, {}, np.isin(np.arange(1000), np.arange(15, 15 + count)))  # 25 samples per command
    assert [len(record.command) for record in log.records] == [count]
    assert {finding.severity for finding in log.findings} <= {"note", "warning"}


@pytest.mark.parametrize("plant", ["mujoco", "mujoco:slow_motors", "mujoco:long"])
@pytest.mark.parametrize("trajectory", ["circle", "s", "square", "fast_circle", "spiral"])
def test_short_drive_at_nearly_constant_speed_has_the_true_gain_and_no_error(tmp_path, trajectory, plant):
    """A drive of ten seconds contains little information, which must not cause an error."""
    run = simulate(Controller(load_config("ssm")), make_plant(plant, seed=22), load_trajectory(trajectory))
    write_rows(run, tmp_path / "drive.csv")
    log = read_log(tmp_path / "drive.csv", "simulate")
    assert not [str(finding) for finding in log.findings if finding.severity == "error"]
    ratio = next(line for line in summary(log) if line.startswith("v ")).split()[4]
    # The long robot does not reach all commanded speeds.
    assert plant == "mujoco:long" or float(ratio) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(("upper", "lower"), [(np.inf, 0.2), (0.15, 0.25), (0.1, np.inf)])
def test_limit_of_the_base_is_not_reported_as_a_wrong_unit(tmp_path, upper, lower):
    """Commands far beyond the limit are up to ten times the speed of the robot."""
    command, speed, pose = 3 * COLUMNS["v_ref"], np.zeros(1000), np.zeros((1000, 3))
    for k in range(1, 1000):
        clipped = np.clip(command[k - 1], -lower, upper)
        speed[k] = speed[k - 1] + (1 - np.exp(-0.02 / 0.1)) * (clipped - speed[k - 1])
        pose[k] = integrate_pose(pose[k - 1], speed[k], COLUMNS["gyro"][k], 0.02)
    noisy = speed + np.random.default_rng(0).normal(0, 0.005, 1000)
    log = read_modified(tmp_path, {"v_ref": command, "v": noisy, **dict(zip(("x", "y", "theta"), pose.T, strict=True))})
    assert texts(log, "wrong unit") == []
