"""Drafted mappings: a log has the same record with the draft as with the correct mapping."""

import numpy as np
import pytest
from log_parts import bag_topics, drive, write_bag, write_csv, write_mapping

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.draft_mapping import draft_mapping
from diffdrive_mpc.models.logs.mapping import load_mapping

COLUMNS = drive(seconds=8.0)
DEGREE = 180.0 / np.pi
FIELDS = ("command", "twist", "yaw_rate", "pose")
# Case: columns in order, their names in the log and the factors from SI units.
ORDER = ("t", "v_ref", "omega_ref", "v", "omega_wheels", "gyro", "x", "y", "theta")
MIXED = ("t", "omega_wheels", "v", "v_ref", "omega_ref", "gyro", "x", "y", "theta")
WORDS = "time,velCmd,yaw_rate_cmd,velMeasured,yaw_rate_measured,imu.angular_velocity.z,mocap/x,mocap/y,mocap/yaw"
UNITS = "stamp_us,v_target_km_h,w_target[deg/s],v_enc_mm_s,w_enc_rpm,gyro_z_dps,x (cm),y (cm),heading_deg"
TOPICS = "/cmd_vel/linear/x,/cmd_vel/angular/z,/odom/twist/linear/x,/odom/twist/angular/z,/imu/angular_velocity/z"
POSES = ",/amcl/odom/position/x,/amcl/odom/position/y,/amcl/odom/yaw"
NAMES = {
    "fields of topics": (ORDER, f"__time,{TOPICS}{POSES}", [1.0] * 9),
    "words and no units": (ORDER, WORDS, [1.0] * 9),
    "units in the names": (ORDER, UNITS, [1e6, 3.6, DEGREE, 1e3, DEGREE / 6.0, DEGREE, 1e2, 1e2, DEGREE]),
    "units by the values, command by what follows it": (
        *(MIXED, "t,w,speed,speed_2,w_2,gz,px,py,psi"),
        [1e3, DEGREE, 1e3, 1e3, DEGREE, DEGREE, 1e3, 1e3, DEGREE],
    ),
}


def draft_of(log, tmp_path):
    return write_mapping(tmp_path / "draft.yaml", draft_mapping(log))


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
def test_columns_and_units_are_guessed(tmp_path, names):
    rows = zip(names[0], names[1].split(","), names[2], strict=True)
    columns = {"/imu/orientation/w": COLUMNS["v"]} | {name: COLUMNS[key] * factor for key, name, factor in rows}
    log = write_csv(tmp_path / "log.csv", columns)
    (drafted,) = read_log(log, draft_of(log, tmp_path)).records
    (correct,) = read_log(write_csv(tmp_path / "right.csv", COLUMNS), write_mapping(tmp_path / "map.yaml")).records
    for field in FIELDS:
        np.testing.assert_allclose(getattr(drafted, field), getattr(correct, field), atol=1e-9, err_msg=field)


@pytest.mark.parametrize(("stamp", "unit"), [(1.7e9, "s"), (1.7e12, "ms"), (1.7e15, "us"), (1.7e18, "ns")])
def test_unnamed_time_since_1970_with_a_gap_and_its_unit_are_guessed(tmp_path, stamp, unit):
    time = COLUMNS["t"] + 14.2 * (COLUMNS["t"] > 4.0)
    log = write_csv(tmp_path / "log.csv", {"zeit": stamp + time * stamp / 1.7e9, **COLUMNS, "t": 0.0 * time})
    time = load_mapping(draft_of(log, tmp_path)).columns.time
    assert (time.column, time.unit) == ("zeit", unit)


def test_seconds_and_nanoseconds_become_one_time(tmp_path):
    time = 1.7e9 + COLUMNS["t"]
    columns = {"stamp.sec": np.floor(time), "stamp.nanosec": np.round((time % 1) * 1e9), **COLUMNS}
    log = write_csv(tmp_path / "log.csv", {name: cells for name, cells in columns.items() if name != "t"})
    (record,) = read_log(log, draft_of(log, tmp_path)).records
    assert record.dt == pytest.approx(0.02, abs=1e-6)


def test_column_that_changes_where_poses_restart_starts_new_stretches(tmp_path):
    rows = np.arange(len(COLUMNS["t"]))
    columns = COLUMNS | {"counter": rows, "half": rows // 160, "run": rows // 80}
    for name in ("x", "y", "theta"):
        columns[name] = columns[name] - columns[name][80 * (rows // 80)]
    log = write_csv(tmp_path / "log.csv", columns)
    assert load_mapping(draft_of(log, tmp_path)).columns.segment == "run"
    assert load_mapping(draft_of(write_csv(tmp_path / "one.csv", COLUMNS), tmp_path)).columns.segment is None


def test_draft_leaves_unknown_values_of_wheels_and_times_empty(tmp_path):
    counts, rows = np.round(1e4 * COLUMNS["t"]), np.arange(len(COLUMNS["t"]))
    columns = {"cmd_left": COLUMNS["v_ref"], "cmd_right": COLUMNS["v"], "enc_left": counts, "enc_right": counts}
    columns |= {"number": rows + 9 * (rows > 50), "angle": np.cumsum(0.02 + 0.004 * np.cos(0.03 * rows))}
    log = write_csv(tmp_path / "log.csv", columns)
    with pytest.raises(ConfigError, match=r"wheels\.track") as error:
        load_mapping(draft_of(log, tmp_path))
    assert "'sample_time' [s] for a log without time stamps" in str(error.value)
    text = draft_mapping(log).replace("sample_time:", "sample_time: 0.02")
    text = text.replace("radius: , track: , ticks_per_turn: ", "radius: 0.1, track: 0.4, ticks_per_turn: 4096")
    mapping = load_mapping(write_mapping(tmp_path / "filled.yaml", text))
    assert (mapping.columns.encoders.left.unit, mapping.columns.command.right.column) == ("ticks", "cmd_right")


def test_topics_are_guessed_by_type_and_name(tmp_path):
    topics = bag_topics(COLUMNS)
    topics |= {"/joy/cmd_vel": topics["/cmd_vel"], "/odometry/filtered": topics["/odom"], "/goal_pose": topics["/pose"]}
    bag = write_bag(tmp_path / "bag", topics)
    mapping = load_mapping(draft_of(bag, tmp_path)).topics
    assert [part.topic for part in (mapping.command, mapping.odometry, mapping.imu, mapping.pose)] == [
        *("/cmd_vel", "/odom", "/imu", "/pose")
    ]
    assert "alternatives: /joy/cmd_vel" in draft_mapping(bag)
    assert "# wheels: {track: }" in draft_mapping(bag)
    assert len(read_log(bag, tmp_path / "draft.yaml").records) == 1
