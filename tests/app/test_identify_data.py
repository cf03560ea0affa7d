"""How records are divided, and what is read off their wheels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_parts import drive, write_csv, write_mapping

from diffdrive_mpc.models.identification.log_data import divide, read_data
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.logs.geometry import firmware_track, wheel_geometry
from diffdrive_mpc.models.wheels import WheelKinematics


def record(count, start=0.0):
    rows = start + np.arange(count)
    return Record("drive", start, 1.0, np.column_stack([rows, rows]))


@given(st.lists(st.integers(1, 40), min_size=1, max_size=6), st.floats(0.1, 0.9))
def test_dividing_keeps_every_row_once_and_in_order(counts, share):
    starts = np.cumsum([0, *counts]) + 10 * np.arange(len(counts) + 1)  # a gap between two records
    records = [record(count, start) for count, start in zip(counts, starts, strict=False)]
    first, last = divide(records, share)
    rows = [np.concatenate([part.command[:, 0] for part in parts]) if parts else np.empty(0) for parts in (first, last)]
    assert np.array_equal(np.concatenate(rows), np.concatenate([part.command[:, 0] for part in records]))
    assert len(rows[0]) == round(share * sum(counts))
    for part in (*first, *last):
        assert part.start == part.command[0, 0]


def driven(radius, track, effective, firmware, gyro=True):
    """A robot whose wheels obey at once: `firmware` on the way in, `effective` on the way out."""
    command = np.random.default_rng(0).uniform([-1.0, -1.5], [1.0, 1.5], (200, 2))
    asked = WheelKinematics(radius, firmware).body_to_wheels @ command.T
    wheels = np.column_stack([asked[[0, 2]].mean(axis=0), asked[[1, 3]].mean(axis=0)])
    difference = radius * (wheels[:, 1] - wheels[:, 0])
    twist = np.column_stack([radius * wheels.mean(axis=1), difference / track])
    yaw_rate = difference / effective if gyro else None
    return Record("drive", 0.0, 0.02, command, twist=twist, yaw_rate=yaw_rate, wheels=wheels)


@given(*[st.floats(0.05, 2.0)] * 4)
def test_radius_and_tracks_are_read_off_the_wheels(radius, track, effective, firmware):
    drive = driven(radius, track, effective, firmware)
    geometry = wheel_geometry([drive])
    assert geometry == pytest.approx((radius, track), rel=1e-9)
    # What the body does for what is commanded: v as asked, omega by the two tracks.
    gain = np.diag([1.0, firmware / effective])
    assert firmware_track([drive], geometry, gain) == pytest.approx(firmware, rel=1e-6)


def test_all_logs_get_the_sample_time_of_the_first(tmp_path):
    mapping = str(write_mapping(tmp_path / "map.yaml"))
    logs = [write_csv(tmp_path / f"{dt}.csv", drive(seconds=20.0, dt=dt)) for dt in (0.02, 0.05)]
    data = read_data(logs, [], mapping=mapping, fit_share=0.75, wheels=False, on_findings=lambda findings: None)
    assert {record.dt for record in (*data.train, *data.validation)} == {0.02}
    spans = [sum(record.end - record.start for record in records) for records in (data.train, data.validation)]
    assert spans == pytest.approx([30.0, 10.0], abs=0.2)


def test_a_stretch_without_the_gyro_is_left_out_with_a_warning(tmp_path):
    columns = drive(seconds=20.0)
    rows = np.r_[0:500, 700:1000]  # a gap of four seconds, after which the gyro is silent
    columns["gyro"] = np.where(columns["t"] > 10.0, np.nan, columns["gyro"])
    log = write_csv(tmp_path / "drive.csv", {name: column[rows] for name, column in columns.items()})
    mapping = str(write_mapping(tmp_path / "map.yaml"))
    data = read_data([log], [], mapping=mapping, fit_share=0.5, wheels=False, on_findings=lambda findings: None)
    assert data.yaw == "gyro"
    assert max(record.end for record in (*data.train, *data.validation)) < 10.0
    assert tuple(doubt.words for doubt in data.warnings) == (
        "drive.csv, 14.0 to 20.0 s: 0 readings of yaw_rate, fewer than 5; the stretch is not used to validate on",
    )
