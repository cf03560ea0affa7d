"""Reader of CSV logs, and errors for invalid files."""

import datetime

import numpy as np
import pytest
from log_parts import DT, MAPPING, drive, write_csv, write_mapping

from diffdrive_mpc import ConfigError, Controller, load_config, load_trajectory, make_plant
from diffdrive_mpc.models.logs import csv_table, read_log
from diffdrive_mpc.models.logs.csv_table import read_table
from diffdrive_mpc.models.logs.long_logs import most_excited_rows
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.log_csv import write_log
from refusals import one_line_error

COLUMNS = drive()


def read_columns(tmp_path, columns, mapping=None, **options):
    path = write_csv(tmp_path / "log.csv", columns)
    return read_log(path, write_mapping(tmp_path / "map.yaml", *([mapping] if mapping else [])), **options)


def test_evenly_sampled_log_is_read_exactly(tmp_path):
    log = read_columns(tmp_path, COLUMNS)
    (record,) = log.records
    assert log.findings == ()
    assert record.dt == DT
    assert np.array_equal(record.command, np.column_stack([COLUMNS["v_ref"], COLUMNS["omega_ref"]]))
    assert np.array_equal(record.twist, np.column_stack([COLUMNS["v"], COLUMNS["omega_wheels"]]))
    assert np.array_equal(record.yaw_rate, COLUMNS["gyro"])
    assert np.array_equal(record.pose[:, :2], np.column_stack([COLUMNS["x"], COLUMNS["y"]]))
    assert record.fresh_twist.all() and record.fresh_yaw_rate.all() and record.fresh_pose.all()
    assert np.allclose(record.time, COLUMNS["t"], atol=1e-12)


def test_units_and_signs_are_converted_to_si(tmp_path):
    mapping = """
columns:
  time: {column: t, unit: ns}
  command: {v: {column: v_ref, unit: mm/s}, omega: {column: omega_ref, unit: rpm}}
  encoders: {v: {column: v, unit: km/h}, omega: {column: omega_wheels, unit: deg/s}}
  gyro: {yaw_rate: {column: gyro, unit: deg/s, sign: -1}}
  pose: {x: {column: x, unit: cm}, y: {column: y, unit: mm}, theta: {column: theta, unit: deg}}
"""
    scale = {"t": 1e9, "v_ref": 1e3, "omega_ref": 30 / np.pi, "v": 3.6, "x": 100, "y": 1e3}
    degrees = {"omega_wheels": 180 / np.pi, "gyro": -180 / np.pi, "theta": 180 / np.pi}
    columns = {name: value * (scale | degrees)[name] for name, value in COLUMNS.items()}
    (record,), (expected,) = read_columns(tmp_path, columns, mapping).records, read_columns(tmp_path, COLUMNS).records
    for field in ("command", "twist", "yaw_rate", "pose"):
        assert np.allclose(getattr(record, field), getattr(expected, field), rtol=1e-9, atol=1e-9), field


WHEELS = """
wheels: {{radius: 0.1, track: 0.5, ticks_per_turn: 1000}}
columns:
  time: t
  command: {{left: {{column: cl, unit: rpm}}, right: {{column: cr, unit: rpm}}}}
  encoders: {{left: {{column: l, unit: {unit}}}, right: {{column: r, unit: {unit}}}}}
"""


@pytest.mark.parametrize(("unit", "factor"), [("rad/s", 10.0), ("m/s", 1.0), ("ticks/s", 1e4 / (2 * np.pi))])
def test_wheel_speeds_are_converted_to_v_and_omega(tmp_path, unit, factor):
    """With radius 0.1 m and track 0.5 m, the rim speeds are v -+ 0.25 omega."""
    rims = {side: COLUMNS["v"] + s * 0.25 * COLUMNS["omega_wheels"] for side, s in (("l", -1), ("r", 1))}
    rpm = 10.0 * 30 / np.pi
    commands = {
        f"c{side}": rpm * (COLUMNS["v_ref"] + s * 0.25 * COLUMNS["omega_ref"]) for side, s in (("l", -1), ("r", 1))
    }
    columns = {"t": COLUMNS["t"], **commands, **{side: factor * rim for side, rim in rims.items()}}
    (record,) = read_columns(tmp_path, columns, WHEELS.format(unit=unit)).records
    assert np.allclose(record.command, np.column_stack([COLUMNS["v_ref"], COLUMNS["omega_ref"]]))
    assert np.allclose(record.twist, np.column_stack([COLUMNS["v"], COLUMNS["omega_wheels"]]))
    assert np.allclose(record.wheels, 10.0 * np.column_stack([rims["l"], rims["r"]]))
    assert np.allclose(record.wheel_commands[:, 1], 10.0 * (COLUMNS["v_ref"] + 0.25 * COLUMNS["omega_ref"]))


def test_tick_counts_are_converted_to_the_mean_speed_between_rows(tmp_path):
    """A wheel with the angle t^2 has the speed 2 t, which equals the mean speed of a step at its middle."""
    angle = COLUMNS["t"] ** 2
    columns = {"t": COLUMNS["t"], "cl": COLUMNS["v_ref"] * 10, "cr": COLUMNS["omega_ref"]}
    columns |= {"l": 1000 / (2 * np.pi) * angle, "r": -1000 / (2 * np.pi) * angle}
    (record,) = read_columns(tmp_path, columns, WHEELS.format(unit="ticks")).records
    assert np.allclose(record.wheels[1:-1], np.outer(2 * record.time[1:-1], [1, -1]), atol=1e-6)
    assert record.fresh_twist[1:-1].all()


def test_speeds_of_four_wheels_are_stored_and_averaged_by_side(tmp_path):
    names = ("front_left", "front_right", "rear_left", "rear_right")
    mapping = """
wheels: {radius: 0.1, track: 0.5}
columns:
  time: t
  command: {v: v_ref, omega: omega_ref}
  encoders: {front_left: front_left, front_right: front_right, rear_left: rear_left, rear_right: rear_right}
"""
    speeds = {name: (i + 1.0) * COLUMNS["v"] for i, name in enumerate(names)}
    columns = {name: COLUMNS[name] for name in ("t", "v_ref", "omega_ref")} | speeds
    (record,) = read_columns(tmp_path, columns, mapping).records
    assert np.array_equal(record.wheel_speeds, np.column_stack(list(speeds.values())))
    assert np.allclose(record.wheels, np.outer(COLUMNS["v"], [2.0, 3.0]))
    assert np.allclose(record.twist, np.outer(COLUMNS["v"], [0.25, 0.2]))


@pytest.mark.parametrize(("period", "quantum"), [(1, 0.2), (2, 0.2), (4, 0.2), (5, 0.02)])
def test_each_held_reading_is_fresh_even_if_its_value_repeats(tmp_path, period, quantum):
    """At constant speed, quantised readings repeat for seconds; `held` preserves all readings."""
    columns = dict(COLUMNS)
    rows = np.arange(len(COLUMNS["t"])) // period * period
    for name in ("v", "omega_wheels"):
        columns[name] = np.round(COLUMNS[name][rows] / quantum) * quantum
    mapping = "columns:\n  time: t\n  command: {v: v_ref, omega: omega_ref}\n"
    mapping += "  encoders: {v: v, omega: omega_wheels, held: true}\n"
    (record,) = read_columns(tmp_path, columns, mapping).records
    assert record.fresh_twist.sum() == pytest.approx(len(rows) / period, rel=0.02)


def test_delay_shifts_readings_to_their_time_of_validity(tmp_path):
    mapping = "columns:\n  time: t\n  command: {v: v_ref, omega: omega_ref}\n  gyro: {yaw_rate: gyro, delay: 0.1}\n"
    (record,) = read_columns(tmp_path, COLUMNS, mapping).records
    assert np.allclose(record.yaw_rate[:-5], COLUMNS["gyro"][5:], atol=1e-12)
    assert not record.fresh_yaw_rate[-5:].any()


def test_segments_and_a_fixed_sample_time_replace_time_stamps(tmp_path):
    columns = COLUMNS | {"run": [f"run {k // 400}" for k in range(1000)]}
    mapping = "columns:\n  sample_time: 0.02\n  segment: run\n  command: {v: v_ref, omega: omega_ref}\n"
    mapping += "  gyro: {yaw_rate: gyro}\n"
    records = read_columns(tmp_path, columns, mapping).records
    assert [len(record.command) for record in records] == [400, 400, 200]
    assert np.array_equal(records[1].yaw_rate, COLUMNS["gyro"][400:800])
    assert [record.dt for record in records] == [0.02] * 3


@pytest.mark.parametrize("kind", ["sec and nanosec", "ISO 8601"])
def test_iso_times_and_ros_stamps_are_read(tmp_path, kind):
    time = np.round(1.7e9 + COLUMNS["t"], 6)
    if kind == "ISO 8601":
        columns = {"t": [datetime.datetime.fromtimestamp(t, datetime.UTC).isoformat() for t in time.tolist()]}
    else:
        columns = {"t": np.floor(time), "nanosec": np.round((time % 1) * 1e9)}
    mapping = MAPPING if kind == "ISO 8601" else MAPPING.replace("time: t", "time: {column: t, nanosec: nanosec}")
    (record,) = read_columns(tmp_path, COLUMNS | columns, mapping).records
    assert record.dt == pytest.approx(0.02, abs=1e-9)
    np.testing.assert_allclose(record.yaw_rate, COLUMNS["gyro"], atol=1e-3)


def test_wrapped_headings_are_unwrapped(tmp_path):
    wrapped = COLUMNS | {"theta": (COLUMNS["theta"] - np.median(COLUMNS["theta"])) % (2 * np.pi)}
    assert np.ptp(np.diff(wrapped["theta"])) > 6
    (record,) = read_columns(tmp_path, wrapped).records
    assert np.allclose(np.diff(record.pose[:, 2]), np.diff(COLUMNS["theta"]), atol=1e-9)


def test_stamps_rounded_to_milliseconds_preserve_the_mean_rate(tmp_path):
    """The samples are 20.2 ms apart; with the median step of 20 ms, one sample in a hundred would be lost."""
    columns = drive(dt=0.0202)
    (record,) = read_columns(tmp_path, columns | {"t": np.round(columns["t"], 3)}).records
    assert record.dt == pytest.approx(0.0202, rel=2e-4)
    assert abs(len(record.command) - len(columns["t"])) <= 1


def test_coarser_sample_time_uses_the_values_at_its_times(tmp_path):
    (record,) = read_columns(tmp_path, COLUMNS, sample_time=0.1).records
    assert np.array_equal(record.yaw_rate, COLUMNS["gyro"][::5])
    assert np.array_equal(record.command[:, 0], COLUMNS["v_ref"][::5])


def test_log_of_simulate_needs_no_mapping(tmp_path):
    """Poses are assigned to their time of validity, not to their time of arrival."""
    run = simulate(
        Controller(load_config("ssm")), make_plant("model:ssm", sensors="slam", seed=3), load_trajectory("s")
    )
    write_log(run, tmp_path / "run.csv")
    log = read_log(tmp_path / "run.csv")
    (record,) = log.records
    assert record.dt == pytest.approx(run.sample_time, rel=1e-9)
    assert np.array_equal(record.command, run.command)
    assert np.array_equal(record.yaw_rate, run.gyro, equal_nan=True)
    true_pose = np.column_stack([np.interp(record.time, run.time, column) for column in run.true_pose.T])
    errors = (record.pose - true_pose)[record.fresh_pose]
    assert 5 < len(errors) < len(record.command)
    is_late = run.measured_pose_time < run.time - 0.5 * record.dt
    displacement = np.linalg.norm(run.measured_pose[is_late, :2] - run.true_pose[is_late, :2], axis=1)
    assert np.median(np.linalg.norm(errors[:, :2], axis=1)) < 0.5 * np.median(displacement)


def test_rows_are_selected_by_time_and_by_the_value_of_a_column(tmp_path):
    mode = ["manual" if t < 4.0 else "auto" for t in COLUMNS["t"]]
    path = write_csv(tmp_path / "log.csv", COLUMNS | {"mode": mode})
    mapping = MAPPING + "  where: {mode: auto}\ntimes: [[3.0, 8.0], [12.0, 14.0]]\n"
    log = read_log(path, write_mapping(tmp_path / "map.yaml", mapping))
    assert [(round(r.start, 2), round(r.end, 2)) for r in log.records] == [(4.0, 8.0), (12.0, 14.0)]
    with pytest.raises(ConfigError, match="no row satisfies 'where'"):
        read_log(path, write_mapping(tmp_path / "map.yaml", mapping.replace("auto", "automatic")))


def test_kilohertz_log_is_decimated_with_a_finding(tmp_path):
    columns = drive(seconds=10.0, dt=0.001)
    log = read_log(write_csv(tmp_path / "log.csv", columns), write_mapping(tmp_path / "map.yaml"))
    assert log.records[0].dt == pytest.approx(0.01)
    assert ["one row in 10" in str(finding) for finding in log.findings] == [True]


def test_long_log_is_reduced_to_its_most_excited_parts():
    speed = np.zeros(1000)
    speed[200:300] = speed[700:800] = np.tile([1.0, -1.0], 50)
    assert list(most_excited_rows([speed], 200, part=100)) == [*range(200, 300), *range(700, 800)]


def test_block_size_does_not_change_the_table(tmp_path, monkeypatch):
    path = write_csv(tmp_path / "log.csv", COLUMNS)
    table = read_table(path, list(COLUMNS))
    monkeypatch.setattr(csv_table, "_BLOCK", 1000)
    blocks = read_table(path, list(COLUMNS))
    assert np.array_equal(table.lines, blocks.lines)
    assert all(np.array_equal(table.values[name], blocks.values[name]) for name in COLUMNS)


@pytest.mark.parametrize("position", ["first", "middle", "last"])
def test_block_parser_agrees_with_the_cell_parser_on_empty_cells(tmp_path, monkeypatch, position):
    """Most cells of a slow sensor are empty, in columns at any position."""
    names = {"first": ["gyro", "v", "t"], "middle": ["t", "gyro", "v", "v_ref"], "last": ["t", "gyro", "v"]}[position]
    is_empty = np.arange(len(COLUMNS["t"])) % 5 > 0
    path = tmp_path / "log.csv"
    rows = [",".join("" if name in ("gyro", "v") and cell_is_empty else repr(float(COLUMNS[name][k])) for name in names)
            for k, cell_is_empty in enumerate(is_empty)]  # fmt: skip
    path.write_text("\n".join([",".join(names), *rows]) + "\n")
    block_table = read_table(path, names)
    monkeypatch.setattr(csv_table, "_parse_with_numpy", lambda *_: None)
    cell_table = read_table(path, names)
    assert np.array_equal(block_table.empty["gyro"], is_empty)
    for name in names:
        assert np.array_equal(block_table.values[name], cell_table.values[name], equal_nan=True)
        assert np.array_equal(block_table.numbers(name)[1], cell_table.numbers(name)[1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (",".join(f"c{i}" for i in range(20_000)) + "\n", "20,000 columns, the limit is 10,000"),
        ("t,v\n0,1\n1," + "1" * 20_000_000, "a line has more than 1,048,576 bytes"),
        ("x" * 2_000_000, "a line has more than 1,048,576 bytes"),
        ("a,b," * 2000 + "a\n1\n", "column 'a' occurs twice"),
    ],
)
def test_file_without_a_table_is_refused_before_parsing(tmp_path, text, message):
    """Parsing a million columns would take minutes, and a file without line ends would exhaust the memory."""
    file = tmp_path / "wide.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        read_table(file, {"t", "v"})


SHORT = drive(seconds=4.0)


def error_message(tmp_path, columns=SHORT, mapping=MAPPING, content=None):
    path = tmp_path / "log.csv"
    path.write_bytes(content) if content is not None else write_csv(path, columns)
    with one_line_error(ConfigError) as error:
        read_log(path, write_mapping(tmp_path / "map.yaml", mapping))
    return str(error.value)


def test_error_for_a_cell_that_is_not_a_number_contains_its_line(tmp_path):
    columns = SHORT | {"gyro": [*SHORT["gyro"][:50], "broken", *SHORT["gyro"][51:]]}
    assert "log.csv, line 52, column 'gyro': 'broken' is not a number" in error_message(tmp_path, columns)


NO_ROWS = "no rows; a log has a header line and a row of numbers per sample"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", NO_ROWS),
        (b"t,v\n", NO_ROWS),
        (b"t,v,v\n1,2,3\n", "column 'v' occurs twice; rename one"),
        (b"t,v\n1,2\n1,2,3\n1,2\n", "log.csv, line 3: 3 cells, expected 2 as in the header"),
        (bytes(range(256)), "cannot be read as CSV"),
    ],
)
def test_invalid_table_raises_error_in_one_line(tmp_path, content, message):
    assert message in error_message(tmp_path, content=content)


def test_truncated_last_row_is_omitted(tmp_path):
    path = write_csv(tmp_path / "log.csv", SHORT)
    path.write_text(path.read_text() + "4.0,0.5")
    log = read_log(path, write_mapping(tmp_path / "map.yaml"))
    assert str(log.findings[0]) == "log.csv, line 202: the line is truncated and left out"
    assert len(log.records[0].command) == 200


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("yaw_rate: gyro", "yaw_rate: {column: gyro, unit: deg}", "should be 'rad/s', 'deg/s', 'mrad/s', 'rpm' or"),
        ("yaw_rate: gyro", "yaw_rate: {column: gyro, sing: -1}", "did you mean 'columns.gyro.yaw_rate.sign'?"),
        ("v: v_ref, omega: omega_ref", "v: v_ref", "columns.command: 'v' also needs 'omega'"),
        ("columns:", "time: t\ncolumns:", "unknown key 'time'; did you mean 'columns.time' or 'times'?"),
        ("columns:", "source: !!python/object/new:os.mkdir [x]\ncolumns:", "unknown tag"),
    ],
)
def test_invalid_mapping_raises_error_in_one_line(tmp_path, old, new, line):
    assert line in error_message(tmp_path, mapping=MAPPING.replace(old, new))


def test_error_lists_all_missing_columns(tmp_path):
    names = {"t": "time", "gyro": "gyr", "theta": "thta"}
    line = error_message(tmp_path, {names.get(name, name): value for name, value in SHORT.items()})
    assert "3 mistakes: (1) column 'gyro' is missing; did you mean 'gyr'?; (2) column 't' is missing; it has " in line
    assert line.endswith("; (3) column 'theta' is missing; did you mean 'thta'?")
