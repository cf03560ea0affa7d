"""Bad CSV logs and bad mapping files: one clear line each, and nothing is ever executed."""

import numpy as np
import pytest
from log_parts import MAPPING, drive, write_csv, write_mapping

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs import read_log

COLUMNS = drive(seconds=4.0)


def line_of(tmp_path, columns=COLUMNS, mapping=MAPPING, text=None, **options):
    path = tmp_path / "log.csv"
    if text is None:
        write_csv(path, columns)
    else:
        path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_log(path, None if mapping is None else write_mapping(tmp_path / "map.yaml", mapping), **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_missing_column_names_the_nearest(tmp_path):
    columns = {("gyr" if name == "gyro" else name): value for name, value in COLUMNS.items()}
    assert line_of(tmp_path, columns).endswith("log.csv: column 'gyro' is missing; did you mean 'gyr'?")


def test_a_log_without_a_mapping_lists_its_columns(tmp_path):
    line = line_of(tmp_path, mapping=None)
    assert line.endswith(
        "which column is what? Give a mapping file; the columns are t, v_ref, omega_ref, v, "
        "omega_wheels, gyro, x, y, theta"
    )


def test_ten_samples_are_too_few(tmp_path):
    line = line_of(tmp_path, {name: value[:10] for name, value in COLUMNS.items()})
    assert line == (
        "log.csv: 10 samples in the longest stretch, at least 20 are needed; record for longer, or give a longer 'gap' "
        "in the mapping (now 0.2 s)"
    )


def test_a_word_among_the_numbers_is_named_by_its_line(tmp_path):
    columns = COLUMNS | {"gyro": [*COLUMNS["gyro"][:50], "broken", *COLUMNS["gyro"][51:]]}
    assert "log.csv, line 52, column 'gyro': 'broken' is no number" in line_of(tmp_path, columns)


def test_two_clocks_are_named(tmp_path):
    columns = COLUMNS | {"stamp": COLUMNS["t"] + 1.7e9}
    mapping = MAPPING.replace("{yaw_rate: gyro}", "{yaw_rate: gyro, time: stamp}")
    assert "two clocks: the times of column 'stamp' are 1700000000.000 s ahead of those of the rows" in line_of(
        tmp_path, columns, mapping
    )


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "no rows; a log has a header line and a row of numbers per sample"),
        ("t,v\n", "no rows; a log has a header line and a row of numbers per sample"),
        ("t,v,v\n1,2,3\n", "column 'v' is there twice; rename one"),
        ("t,v\n1,2\n1,2,3\n1,2\n", "log.csv, line 3: 3 cells, expected 2 as in the header"),
    ],
)
def test_a_file_that_is_no_table_is_one_line(tmp_path, text, line):
    assert line in line_of(tmp_path, text=text)


def test_bytes_that_are_no_text_are_one_line(tmp_path):
    (tmp_path / "log.csv").write_bytes(bytes(range(256)))
    with pytest.raises(ConfigError, match="cannot be read as CSV"):
        read_log(tmp_path / "log.csv")


def test_a_row_cut_off_at_the_end_is_left_out(tmp_path):
    path = write_csv(tmp_path / "log.csv", COLUMNS)
    path.write_text(path.read_text() + "4.0,0.5")
    log = read_log(path, write_mapping(tmp_path / "map.yaml"))
    assert [str(finding) for finding in log.findings] == ["log.csv, line 202: cut off; it is left out"]
    assert len(log.records[0].command) == 200


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(ConfigError, match=r"none.csv: there is no such file or folder"):
        read_log(tmp_path / "none.csv")


def test_all_times_the_same_is_one_line(tmp_path):
    assert "no two rows follow each other in time" in line_of(tmp_path, COLUMNS | {"t": np.zeros(200)})


def test_a_log_without_any_command_is_one_line(tmp_path):
    path = write_csv(tmp_path / "log.csv", COLUMNS | {"v_ref": [""] * 200})
    assert "column 'v_ref' is empty in every row" in line_of(tmp_path, text=path.read_text())


def test_a_sample_time_must_be_positive(tmp_path):
    assert line_of(tmp_path, sample_time=0.0) == "sample time 0.0 s; it must be positive and finite"


def test_an_unknown_mapping_names_the_nearest(tmp_path):
    path = write_csv(tmp_path / "log.csv", COLUMNS)
    with pytest.raises(ConfigError, match=r"unknown mapping 'husky_tiles'.*did you mean 'husky_tile'\?"):
        read_log(path, "husky_tiles")


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            "yaw_rate: gyro",
            "yaw_rate: {column: gyro, unit: deg}",
            "unit: Input should be 'rad/s', 'deg/s', 'rpm' or 'rev/s'",
        ),
        ("yaw_rate: gyro", "yaw_rate: {column: gyro, sing: -1}", "did you mean 'columns.gyro.yaw_rate.sign'?"),
        ("yaw_rate: gyro", "yaw_rate: {column: gyro, sign: 0}", "sign: Input should be 1 or -1 (found 0)"),
        ("v: v_ref, omega: omega_ref", "v: v_ref", "columns.command: 'v' needs 'omega' beside it"),
        ("v: v_ref, omega: omega_ref", "left: v, right: v, v: v, omega: v", "or of left and right, not both"),
        ("v: v_ref, omega: omega_ref", "left: v, right: v", "needs 'wheels' with radius and track [m]"),
        ("{v: v, omega: omega_wheels}", "{}", "name the columns of v, omega or of left, right or of front_left"),
        ("time: t", "time: t\n  sample_time: 0.1", "give either 'time', the column of times, or 'sample_time'"),
        ("columns:", "colums:", "unknown key 'colums'; did you mean 'columns'?"),
        ("columns:", "time: t\ncolumns:", "unknown key 'time'; did you mean 'columns.time' or 'times'?"),
        ("yaw_rate: gyro", "yaw_rate: gyro, yaw: gyro", "did you mean 'columns.gyro.yaw_rate'?"),
        ("  pose:", "  imu: {yaw_rate: gyro}\n  pose:", "did you mean 'columns.gyro'?"),
    ],
)
def test_a_mistake_in_a_mapping_is_one_line(tmp_path, old, new, line):
    assert line in line_of(tmp_path, mapping=MAPPING.replace(old, new))


def test_three_mistakes_in_a_mapping_are_one_line_with_all_three(tmp_path):
    mapping = MAPPING.replace("columns:", "time: t\ncolumns:").replace(
        "yaw_rate: gyro", "yaw_rate: {column: gyro, unit: deg}"
    )
    line = line_of(tmp_path, mapping=mapping.replace("x: x,", "xx: x,"))
    for mistake in ("unknown key 'columns.pose.xx'", "Input should be 'rad/s'", "did you mean 'columns.time'"):
        assert mistake in line


def test_three_missing_columns_are_one_line_with_all_three(tmp_path):
    names = {"t": "time", "gyro": "gyr", "theta": "thta"}
    line = line_of(tmp_path, {names.get(name, name): value for name, value in COLUMNS.items()})
    assert "3 mistakes: (1) column 'gyro' is missing; did you mean 'gyr'?; (2) column 't' is missing; it has " in line
    assert line.endswith("; (3) column 'theta' is missing; did you mean 'thta'?")


def test_ticks_need_the_ticks_of_a_turn(tmp_path):
    mapping = "wheels: {radius: 0.1, track: 0.4}\n" + MAPPING.replace(
        "{v: v, omega: omega_wheels}", "{left: {column: v, unit: ticks}, right: {column: v, unit: ticks}}"
    )
    assert "the mapping needs 'wheels.ticks_per_turn' for 'v'" in line_of(tmp_path, mapping=mapping)


def test_a_mapping_with_nothing_measured_is_one_line(tmp_path):
    mapping = "columns:\n  time: t\n  command: {v: v_ref, omega: omega_ref}\n"
    assert "nothing measured: name the columns of 'encoders', 'gyro' or 'pose'" in line_of(tmp_path, mapping=mapping)


def test_a_mapping_of_topics_cannot_read_a_csv(tmp_path):
    assert "the mapping has no 'columns', which a CSV file needs" in line_of(tmp_path, mapping="topics: {imu: /imu}")


@pytest.mark.parametrize("tag", ["!!python/object/apply:os.mkdir", "!!python/object/new:os.mkdir"])
def test_a_mapping_with_a_python_tag_runs_nothing(tmp_path, tag):
    trap = tmp_path / "trap"
    line = line_of(tmp_path, mapping=f"source: {tag} ['{trap}']\n{MAPPING}")
    assert "unknown tag" in line
    assert not trap.exists()
