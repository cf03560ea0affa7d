"""Public function `identify`: from logs to a controller, without the command line."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_parts import drive, write_csv, write_mapping

from diffdrive_mpc import ConfigError, Controller, identify, load_config, load_model
from diffdrive_mpc.models.identification.deliver.configuration import NODE_FILE
from diffdrive_mpc.models.identification.from_logs import FILES
from diffdrive_mpc.models.identification.log_data import divide, read_data
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.logs.geometry import firmware_track, wheel_geometry
from diffdrive_mpc.models.wheels import WheelKinematics


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    write_mapping(folder / "map.yaml")
    for name, seed in (("one", 0), ("two", 1)):
        write_csv(folder / f"{name}.csv", drive(seconds=20.0, seed=seed))
    return folder


@pytest.fixture(scope="module")
def identification(folder):
    return identify([folder / "one.csv"], mapping=folder / "map.yaml", structure="sm", validate=[folder / "two.csv"])


def test_identified_model_matches_the_robot_and_drives(identification):
    assert np.diag(identification.model.dc_gain) == pytest.approx([1.0, 1.0], abs=0.02)
    assert identification.model.name == "SM from one"
    controller = Controller(load_config(identification.config), model=identification.model)
    assert controller.config.limits.v == identification.config["limits"]["v"]
    assert controller.config.sample_time == pytest.approx(0.02)


def test_written_files_equal_the_identification(identification, tmp_path):
    identification.write(tmp_path / "new" / "mine")
    folder = tmp_path / "new" / "mine"
    assert sorted(path.name for path in folder.iterdir()) == sorted(set(FILES) - {NODE_FILE})
    config, expected = load_config(folder / "config.yaml"), load_config(identification.config)
    assert config.model_copy(update={"model": expected.model}) == expected
    assert config.model == str(folder / "model.yaml")
    loaded = load_model(folder / "model.yaml")
    for name in ("A", "B", "C", "dead_time"):
        assert getattr(loaded, name).tolist() == getattr(identification.model, name).tolist()
    identification.write(folder)  # a second write replaces the files


def test_configuration_without_its_model_is_refused(identification, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"no file 'model\.yaml'.*model=result\.model"):
        Controller(identification.config)


def test_data_frames_give_the_model_of_their_files(folder, identification):
    logs = [pd.read_csv(folder / f"{name}.csv") for name in ("one", "two")]
    model = identify(logs[0], folder / "map.yaml", "sm", validate=logs[1]).model
    assert model.name == "SM from data frame 0"
    assert model.A.tolist() == identification.model.A.tolist()


# Division of records, and geometry of wheels.


def record(count, start=0.0):
    rows = start + np.arange(count)
    return Record("drive", start, 1.0, np.column_stack([rows, rows]))


@given(st.lists(st.integers(1, 40), min_size=1, max_size=6), st.floats(0.1, 0.9))
def test_division_contains_every_row_once_and_in_order(counts, fraction):
    starts = np.cumsum([0, *counts]) + 10 * np.arange(len(counts) + 1)  # a gap between two records
    records = [record(count, start) for count, start in zip(counts, starts, strict=False)]
    first, last = divide(records, fraction)
    rows = [np.concatenate([part.command[:, 0] for part in parts]) if parts else np.empty(0) for parts in (first, last)]
    assert np.array_equal(np.concatenate(rows), np.concatenate([part.command[:, 0] for part in records]))
    assert len(rows[0]) == round(fraction * sum(counts))
    for part in (*first, *last):
        assert part.start == part.command[0, 0]


def wheel_drive(radius, track, effective, firmware, gyro=True):
    """Return a drive of wheels without lag; `firmware` and `effective` are the tracks of commands and body [m]."""
    command = np.random.default_rng(0).uniform([-1.0, -1.5], [1.0, 1.5], (200, 2))
    requested = WheelKinematics(radius, firmware).body_to_wheels @ command.T
    wheels = np.column_stack([requested[[0, 2]].mean(axis=0), requested[[1, 3]].mean(axis=0)])
    difference = radius * (wheels[:, 1] - wheels[:, 0])
    twist = np.column_stack([radius * wheels.mean(axis=1), difference / track])
    yaw_rate = difference / effective if gyro else None
    return Record("drive", 0.0, 0.02, command, twist=twist, yaw_rate=yaw_rate, wheels=wheels)


@given(*[st.floats(0.05, 2.0)] * 4)
def test_radius_and_tracks_are_estimated_from_the_wheels(radius, track, effective, firmware):
    drive = wheel_drive(radius, track, effective, firmware)
    geometry = wheel_geometry([drive])
    assert geometry == pytest.approx((radius, track), rel=1e-9)
    # Gain of the body per command: v as commanded, omega by the ratio of the tracks.
    gain = np.diag([1.0, firmware / effective])
    assert firmware_track([drive], geometry, gain) == pytest.approx(firmware, rel=1e-6)


def test_all_logs_get_the_sample_time_of_the_first(tmp_path):
    mapping = str(write_mapping(tmp_path / "map.yaml"))
    logs = [write_csv(tmp_path / f"{dt}.csv", drive(seconds=20.0, dt=dt)) for dt in (0.02, 0.05)]
    data = read_data(logs, [], mapping=mapping, fit_share=0.75, wheels=False, on_findings=lambda findings: None)
    assert {record.dt for record in (*data.train, *data.validation)} == {0.02}
    spans = [sum(record.end - record.start for record in records) for records in (data.train, data.validation)]
    assert spans == pytest.approx([30.0, 10.0], abs=0.2)


def test_stretch_without_the_gyro_is_skipped_with_a_warning(tmp_path):
    columns = drive(seconds=20.0)
    rows = np.r_[0:500, 700:1000]  # a gap of four seconds, after which the gyro has no readings
    columns["gyro"] = np.where(columns["t"] > 10.0, np.nan, columns["gyro"])
    log = write_csv(tmp_path / "drive.csv", {name: column[rows] for name, column in columns.items()})
    mapping = str(write_mapping(tmp_path / "map.yaml"))
    data = read_data([log], [], mapping=mapping, fit_share=0.5, wheels=False, on_findings=lambda findings: None)
    assert data.yaw == "gyro"
    assert max(record.end for record in (*data.train, *data.validation)) < 10.0
    assert tuple(doubt.message for doubt in data.warnings) == (
        "drive.csv, 14.0 to 20.0 s: 0 readings of a gyro, fewer than 5; the stretch is not used for validation",
    )
