"""CSV logs: units, signs, wheels, held readings, delays, segments, and the logs of our own simulation."""

import numpy as np
import pytest
from log_parts import DT, MAPPING, drive, write_csv, write_mapping

from diffdrive_mpc import ConfigError, Controller, load_config, load_trajectory
from diffdrive_mpc.models.logs import csv_table, read_log
from diffdrive_mpc.models.logs.csv_table import read_table
from diffdrive_mpc.models.logs.long_logs import most_driven
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc.sim.log_csv import write_log

COLUMNS = drive()


def read(tmp_path, columns, mapping=None, **options):
    path = write_csv(tmp_path / "log.csv", columns)
    return read_log(path, write_mapping(tmp_path / "map.yaml", *([mapping] if mapping else [])), **options)


def test_an_even_log_comes_back_bit_for_bit(tmp_path):
    log = read(tmp_path, COLUMNS)
    (record,) = log.records
    assert log.findings == ()
    assert record.dt == DT
    assert np.array_equal(record.command, np.column_stack([COLUMNS["v_ref"], COLUMNS["omega_ref"]]))
    assert np.array_equal(record.twist, np.column_stack([COLUMNS["v"], COLUMNS["omega_wheels"]]))
    assert np.array_equal(record.yaw_rate, COLUMNS["gyro"])
    assert np.array_equal(record.pose[:, :2], np.column_stack([COLUMNS["x"], COLUMNS["y"]]))
    assert record.fresh_twist.all() and record.fresh_yaw_rate.all() and record.fresh_pose.all()
    assert np.allclose(record.time, COLUMNS["t"], atol=1e-12)


def test_units_and_signs_come_out_in_si(tmp_path):
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
    (record,), (plain,) = read(tmp_path, columns, mapping).records, read(tmp_path, COLUMNS).records
    for field in ("command", "twist", "yaw_rate", "pose"):
        assert np.allclose(getattr(record, field), getattr(plain, field), rtol=1e-9, atol=1e-9), field


WHEELS = """
wheels: {{radius: 0.1, track: 0.5, ticks_per_turn: 1000}}
columns:
  time: t
  command: {{left: {{column: cl, unit: rpm}}, right: {{column: cr, unit: rpm}}}}
  encoders: {{left: {{column: l, unit: {unit}}}, right: {{column: r, unit: {unit}}}}}
"""


@pytest.mark.parametrize(("unit", "factor"), [("rad/s", 10.0), ("m/s", 1.0), ("ticks/s", 1e4 / (2 * np.pi))])
def test_wheels_become_v_and_omega(tmp_path, unit, factor):
    """Radius 0.1 m and track 0.5 m: each rim runs at v -+ 0.25 omega."""
    rims = {side: COLUMNS["v"] + s * 0.25 * COLUMNS["omega_wheels"] for side, s in (("l", -1), ("r", 1))}
    rpm = 10.0 * 30 / np.pi
    commands = {
        f"c{side}": rpm * (COLUMNS["v_ref"] + s * 0.25 * COLUMNS["omega_ref"]) for side, s in (("l", -1), ("r", 1))
    }
    columns = {"t": COLUMNS["t"], **commands, **{side: factor * rim for side, rim in rims.items()}}
    (record,) = read(tmp_path, columns, WHEELS.format(unit=unit)).records
    assert np.allclose(record.command, np.column_stack([COLUMNS["v_ref"], COLUMNS["omega_ref"]]))
    assert np.allclose(record.twist, np.column_stack([COLUMNS["v"], COLUMNS["omega_wheels"]]))
    assert np.allclose(record.wheels, 10.0 * np.column_stack([rims["l"], rims["r"]]))
    assert np.allclose(record.wheel_commands[:, 1], 10.0 * (COLUMNS["v_ref"] + 0.25 * COLUMNS["omega_ref"]))


def test_counted_ticks_become_the_mean_speed_between_two_rows(tmp_path):
    """A wheel whose angle is t^2 turns at 2 t, exactly so in the middle of each step."""
    angle = COLUMNS["t"] ** 2
    columns = {"t": COLUMNS["t"], "cl": COLUMNS["v_ref"] * 10, "cr": COLUMNS["omega_ref"]}
    columns |= {"l": 1000 / (2 * np.pi) * angle, "r": -1000 / (2 * np.pi) * angle}
    (record,) = read(tmp_path, columns, WHEELS.format(unit="ticks")).records
    assert np.allclose(record.wheels[1:-1], np.outer(2 * record.time[1:-1], [1, -1]), atol=1e-6)
    assert record.fresh_twist[1:-1].all()


def test_four_wheels_are_kept_and_averaged_by_side(tmp_path):
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
    (record,) = read(tmp_path, columns, mapping).records
    assert np.array_equal(record.wheel_speeds, np.column_stack(list(speeds.values())))
    assert np.allclose(record.wheels, np.outer(COLUMNS["v"], [2.0, 3.0]))
    assert np.allclose(record.twist, np.outer(COLUMNS["v"], [0.25, 0.2]))


def test_of_held_readings_only_the_new_ones_are_fresh(tmp_path):
    """Encoders at a fifth of the rate: one sample in five is a reading, and these carry its value."""
    columns = dict(COLUMNS)
    for name in ("v", "omega_wheels"):
        columns[name] = np.repeat(COLUMNS[name][::5], 5)
    mapping = "columns:\n  time: t\n  command: {v: v_ref, omega: omega_ref}\n"
    mapping += "  encoders: {v: v, omega: omega_wheels, held: true}\n"
    (record,) = read(tmp_path, columns, mapping).records
    assert np.array_equal(np.flatnonzero(record.fresh_twist), np.arange(0, len(COLUMNS["t"]), 5))
    assert np.array_equal(record.twist[record.fresh_twist, 0], COLUMNS["v"][::5])


def test_held_readings_of_a_robot_at_rest_count_as_well(tmp_path):
    columns = {name: value.copy() for name, value in COLUMNS.items()}
    for name in ("v", "omega_wheels"):
        columns[name] = np.repeat(COLUMNS[name][::5], 5)
        columns[name][500:600] = 0.0
    mapping = "columns:\n  time: t\n  command: {v: v_ref, omega: omega_ref}\n"
    mapping += "  encoders: {v: v, omega: omega_wheels, held: true}\n  gyro: {yaw_rate: gyro}\n"
    columns["v_ref"][500:600] = columns["omega_ref"][500:600] = 0.0
    (record,) = read(tmp_path, columns, mapping).records
    assert record.fresh_twist[500:600].sum() == 20


@pytest.mark.parametrize(("period", "quantum"), [(1, 0.2), (2, 0.2), (4, 0.2), (5, 0.02)])
def test_one_reading_a_period_is_fresh_also_where_a_coarse_one_repeats(tmp_path, period, quantum):
    """At one speed quantised readings stay the same for seconds; `held` loses none of them."""
    columns = dict(COLUMNS)
    rows = np.arange(len(COLUMNS["t"])) // period * period
    for name in ("v", "omega_wheels"):
        columns[name] = np.round(COLUMNS[name][rows] / quantum) * quantum
    mapping = "columns:\n  time: t\n  command: {v: v_ref, omega: omega_ref}\n"
    mapping += "  encoders: {v: v, omega: omega_wheels, held: true}\n"
    (record,) = read(tmp_path, columns, mapping).records
    assert record.fresh_twist.sum() == pytest.approx(len(rows) / period, rel=0.02)


def test_a_delay_moves_readings_back_to_when_they_were_true(tmp_path):
    mapping = "columns:\n  time: t\n  command: {v: v_ref, omega: omega_ref}\n  gyro: {yaw_rate: gyro, delay: 0.1}\n"
    (record,) = read(tmp_path, COLUMNS, mapping).records
    assert np.allclose(record.yaw_rate[:-5], COLUMNS["gyro"][5:], atol=1e-12)
    assert not record.fresh_yaw_rate[-5:].any()


def test_segments_and_a_fixed_sample_time_replace_time_stamps(tmp_path):
    columns = COLUMNS | {"run": [f"run {k // 400}" for k in range(1000)]}
    mapping = "columns:\n  sample_time: 0.02\n  segment: run\n  command: {v: v_ref, omega: omega_ref}\n"
    mapping += "  gyro: {yaw_rate: gyro}\n"
    records = read(tmp_path, columns, mapping).records
    assert [len(record.command) for record in records] == [400, 400, 200]
    assert np.array_equal(records[1].yaw_rate, COLUMNS["gyro"][400:800])
    assert [record.dt for record in records] == [0.02] * 3


def test_a_sensor_may_be_silent_in_a_whole_stretch(tmp_path):
    half = len(COLUMNS["t"]) // 2
    silent = [*COLUMNS["gyro"][:half], *[""] * half]
    columns = COLUMNS | {"gyro": silent, "run": [float(k >= half) for k in range(2 * half)]}
    first, second = read(tmp_path, columns, MAPPING + "  segment: run\n").records
    assert first.fresh_yaw_rate.all() and not second.fresh_yaw_rate.any()
    assert second.fresh_twist.all()


def test_wrapped_headings_are_unwrapped(tmp_path):
    wrapped = COLUMNS | {"theta": (COLUMNS["theta"] - np.median(COLUMNS["theta"])) % (2 * np.pi)}
    assert np.ptp(np.diff(wrapped["theta"])) > 6
    (record,) = read(tmp_path, wrapped).records
    assert np.allclose(np.diff(record.pose[:, 2]), np.diff(COLUMNS["theta"]), atol=1e-9)


def test_stamps_rounded_to_milliseconds_keep_the_mean_rate(tmp_path):
    """202 us times 100: a median step of 20 ms would lose one sample in a hundred."""
    columns = drive(dt=0.0202)
    (record,) = read(tmp_path, columns | {"t": np.round(columns["t"], 3)}).records
    assert record.dt == pytest.approx(0.0202, rel=2e-4)
    assert abs(len(record.command) - len(columns["t"])) <= 1


def test_a_coarser_sample_time_takes_the_values_at_its_own_times(tmp_path):
    (record,) = read(tmp_path, COLUMNS, sample_time=0.1).records
    assert np.array_equal(record.yaw_rate, COLUMNS["gyro"][::5])
    assert np.array_equal(record.command[:, 0], COLUMNS["v_ref"][::5])


def test_semicolons_and_a_byte_order_mark_are_read(tmp_path):
    path = write_csv(tmp_path / "log.csv", COLUMNS)
    path.write_text("\ufeff" + path.read_text().replace(",", ";"), encoding="utf-8")
    (record,) = read_log(path, write_mapping(tmp_path / "map.yaml")).records
    assert np.array_equal(record.yaw_rate, COLUMNS["gyro"])


def test_a_log_of_simulate_needs_no_mapping(tmp_path):
    """Poses stand where they were true, not where they arrived: near the true pose of a robot that moves on."""
    run = simulate(
        Controller(load_config("ssm")), make_plant("model:ssm", sensors="slam", seed=3), load_trajectory("s")
    )
    write_log(run, tmp_path / "run.csv")
    log = read_log(tmp_path / "run.csv")
    (record,) = log.records
    assert record.dt == pytest.approx(run.sample_time, rel=1e-9)
    assert np.array_equal(record.command, run.command)
    assert np.array_equal(record.yaw_rate, run.gyro, equal_nan=True)
    true = np.column_stack([np.interp(record.time, run.time, column) for column in run.true_pose.T])
    errors = (record.pose - true)[record.fresh_pose]
    assert 5 < len(errors) < len(record.command)
    late = run.measured_pose_time < run.time - 0.5 * record.dt
    moved = np.linalg.norm(run.measured_pose[late, :2] - run.true_pose[late, :2], axis=1)
    assert np.median(np.linalg.norm(errors[:, :2], axis=1)) < 0.5 * np.median(moved)


def test_rows_are_chosen_by_time_and_by_the_value_of_a_column(tmp_path):
    mode = ["manual" if t < 4.0 else "auto" for t in COLUMNS["t"]]
    path = write_csv(tmp_path / "log.csv", COLUMNS | {"mode": mode})
    chosen = MAPPING + "  where: {mode: auto}\ntimes: [[3.0, 8.0], [12.0, 14.0]]\n"
    log = read_log(path, write_mapping(tmp_path / "map.yaml", chosen))
    assert [(round(r.start, 2), round(r.end, 2)) for r in log.records] == [(4.0, 8.0), (12.0, 14.0)]
    with pytest.raises(ConfigError, match="no row has"):
        read_log(path, write_mapping(tmp_path / "map.yaml", chosen.replace("auto", "automatic")))


def test_rows_left_out_by_where_end_a_stretch(tmp_path):
    """Without time stamps, too: the rows before and after are not next to each other."""
    joystick = (np.arange(len(COLUMNS["t"])) // 250 % 2).astype(float)
    path = write_csv(tmp_path / "log.csv", COLUMNS | {"joystick": joystick})
    mapping = MAPPING.replace("time: t", "sample_time: 0.02") + "  where: {joystick: 0}\n"
    log = read_log(path, write_mapping(tmp_path / "map.yaml", mapping))
    assert [len(record.command) for record in log.records] == [250] * (len(COLUMNS["t"]) // 500)
    assert [record.start for record in log.records] == [10.0 * i for i in range(len(log.records))]


def test_a_kilohertz_log_is_thinned_and_that_is_said(tmp_path):
    columns = drive(seconds=10.0, dt=0.001)
    log = read_log(write_csv(tmp_path / "log.csv", columns), write_mapping(tmp_path / "map.yaml"))
    assert log.records[0].dt == pytest.approx(0.01)
    assert ["one row in 10" in str(finding) for finding in log.findings] == [True]


def test_of_a_long_log_the_parts_that_are_driven_most_are_used():
    lively = np.zeros(1000)
    lively[200:300] = lively[700:800] = np.tile([1.0, -1.0], 50)
    assert list(most_driven([lively], 200, part=100)) == [*range(200, 300), *range(700, 800)]


def test_a_file_is_read_the_same_in_small_blocks(tmp_path, monkeypatch):
    path = write_csv(tmp_path / "log.csv", COLUMNS)
    whole = read_table(path, list(COLUMNS))
    monkeypatch.setattr(csv_table, "_BLOCK", 1000)
    blocks = read_table(path, list(COLUMNS))
    assert np.array_equal(whole.lines, blocks.lines)
    assert all(np.array_equal(whole.values[name], blocks.values[name]) for name in COLUMNS)


@pytest.mark.parametrize("place", ["first", "middle", "last"])
def test_empty_cells_read_the_same_in_a_block_as_cell_by_cell(tmp_path, monkeypatch, place):
    """A sensor slower than the rows leaves most of its cells empty, wherever its columns stand."""
    names = {"first": ["gyro", "v", "t"], "middle": ["t", "gyro", "v", "v_ref"], "last": ["t", "gyro", "v"]}[place]
    silent = np.arange(len(COLUMNS["t"])) % 5 > 0
    path = tmp_path / "log.csv"
    rows = [",".join("" if name in ("gyro", "v") and off else repr(float(COLUMNS[name][k])) for name in names)
            for k, off in enumerate(silent)]  # fmt: skip
    path.write_text("\n".join([",".join(names), *rows]) + "\n")
    quick = read_table(path, names)
    monkeypatch.setattr(csv_table, "_quick", lambda *_: None)
    careful = read_table(path, names)
    assert np.array_equal(quick.empty["gyro"], silent)
    for name in names:
        assert np.array_equal(quick.values[name], careful.values[name], equal_nan=True)
        assert np.array_equal(quick.numbers(name)[1], careful.numbers(name)[1])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (",".join(f"c{i}" for i in range(20_000)) + "\n", "20,000 columns, at most 10,000"),
        ("t,v\n0,1\n1," + "1" * 20_000_000, "a line of more than 1,048,576 bytes"),
        ("x" * 2_000_000, "a line of more than 1,048,576 bytes"),
        ("a,b," * 2000 + "a\n1\n", "column 'a' is there twice"),
    ],
)
def test_what_is_no_table_is_refused_before_it_is_taken_apart(tmp_path, text, words):
    """A million columns took minutes, a file without an end of line all memory."""
    file = tmp_path / "wide.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=words):
        read_table(file, {"t", "v"})
