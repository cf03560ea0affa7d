"""Tables of spreadsheets, loggers and data frames are read, or refused with the reason in one line."""

import csv
import io

import numpy as np
import pytest
from log_parts import drive, write_csv, write_mapping

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.csv_layout import open_csv
from diffdrive_mpc.models.logs.draft_mapping import draft_mapping
from refusals import one_line_error

COLUMNS = drive(seconds=6.0)
NAMES = list(COLUMNS)


def rows(format_number=repr):
    return [[format_number(float(cell)) for cell in row] for row in zip(*COLUMNS.values(), strict=True)]


def with_comma(number):
    return repr(number).replace(".", ",")


def text_of(header, cells, **options):
    file = io.StringIO(newline="")
    csv.writer(file, **options).writerows([header, *cells] if header else cells)
    return file.getvalue()


def error_message(path, mapping):
    with one_line_error(ConfigError) as error:
        read_log(path, mapping)
    return str(error.value)


COMMAS = text_of(NAMES, rows(with_comma), delimiter=";")
DATES = text_of([*NAMES, "date"], [[*row, "26.11.2026"] for row in rows(with_comma)], delimiter=";")
EMPTY = [[*row, "", ""] for row in rows()]
FORMATS = {
    "decimal comma, semicolons": COMMAS,
    "decimal comma beside dates with points": DATES,
    "Excel": "sep=;\r\n" + COMMAS,
    "quoted": text_of(NAMES, rows(), quoting=csv.QUOTE_ALL),
    "quoted, decimal comma": text_of(NAMES, rows(with_comma), delimiter=";", quoting=csv.QUOTE_ALL),
    "columns without a name at the end": text_of([*NAMES, "", ""], EMPTY),
    "empty cells behind some rows only": text_of([*NAMES, "", ""], [*EMPTY[:16], *rows()[16:]]),
}


@pytest.mark.parametrize("text", FORMATS.values(), ids=FORMATS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be"])
def test_table_is_read_equally_in_every_format(tmp_path, text, encoding):
    path = tmp_path / "log.csv"
    mark = b"\xfe\xff" if encoding == "utf-16-be" else b""
    path.write_bytes(mark + text.encode(encoding))
    log = read_log(path, write_mapping(tmp_path / "map.yaml"))
    (record,) = log.records
    assert log.findings == ()
    assert np.array_equal(record.yaw_rate, COLUMNS["gyro"])
    assert np.array_equal(record.command[:, 1], COLUMNS["omega_ref"])
    assert "yaw_rate: {column: gyro, unit: rad/s}" in draft_mapping(path)


def test_long_file_in_utf_16_is_read_completely(tmp_path):
    """The file exceeds any buffer and has characters of one, two, three and four bytes."""
    text = "".join(f"{k};ä€😀\n" for k in range(50_000))
    (tmp_path / "log.csv").write_bytes(text.encode("utf-16"))
    with open_csv(tmp_path / "log.csv") as file:
        assert file.read().decode() == text


@pytest.mark.parametrize("cell", ["NA", "N/A", "null", "None", "-", "NaN", "nan", "inf", ""])
def test_word_for_a_missing_reading_omits_that_reading(tmp_path, cell):
    gyro = [cell if k % 10 == 0 else float(value) for k, value in enumerate(COLUMNS["gyro"])]
    path = write_csv(tmp_path / "log.csv", COLUMNS | {"gyro": gyro})
    (record,) = read_log(path, write_mapping(tmp_path / "map.yaml")).records
    assert np.array_equal(record.fresh_yaw_rate, np.arange(len(gyro)) % 10 > 0)
    assert np.array_equal(record.yaw_rate[record.fresh_yaw_rate], COLUMNS["gyro"][record.fresh_yaw_rate])


INVALID_TABLES = {
    "no header": (text_of(None, rows()), "line 1 holds numbers, not the names of the columns; add a line of 9 names"),
    "decimal comma between commas": (
        "t,v\n0,02,1,5\n0,04,1,6\n",
        "line 2: 4 cells, expected 2 as in the header; if decimals have a comma, put semicolons between",
    ),
    "points and commas": (
        text_of(NAMES, [*rows(with_comma), *rows()], delimiter=";"),
        "is not a number; write decimals with a point, or with a comma throughout",
    ),
    "a pointer of Git LFS": (
        "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n",
        "log.csv: cannot be read as CSV (it is a pointer of Git LFS, not the file; fetch it: `git lfs pull`)",
    ),
}


@pytest.mark.parametrize(("text", "message"), INVALID_TABLES.values(), ids=INVALID_TABLES)
def test_unreadable_table_is_refused_with_the_reason_in_one_line(tmp_path, text, message):
    path = tmp_path / "log.csv"
    path.write_text(text, newline="")
    assert message in error_message(path, write_mapping(tmp_path / "map.yaml"))
