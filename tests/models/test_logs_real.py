"""Logs of real robots, read whole through the shipped mappings."""

import numpy as np
import pytest
from real_log_files import log_path

from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.mapping import MAPPINGS, load_mapping


@pytest.mark.parametrize("name", [path.stem for path in sorted(MAPPINGS.glob("*.yaml"))])
def test_every_shipped_mapping_says_where_it_comes_from(name):
    assert load_mapping(name).source


@pytest.mark.real_logs
def test_the_husky_log_has_its_three_stretches():
    log = read_log(log_path("husky_tile"), "husky_tile")
    assert [round(record.end - record.start) for record in log.records] == [653, 30, 526]
    assert [finding.kind for finding in log.findings] == ["gap", "gap"]
    assert all(record.dt == 0.05 for record in log.records)


@pytest.mark.real_logs
def test_the_huskys_encoders_and_poses_are_fresh_at_about_half_the_rate():
    (record, *_) = read_log(log_path("husky_tile"), "husky_tile").records
    assert 0.45 < record.fresh_twist.mean() < 0.6
    assert 0.45 < record.fresh_pose.mean() < 0.6
    assert record.fresh_yaw_rate.mean() > 0.95


@pytest.mark.real_logs
def test_after_the_stated_delay_the_huskys_encoders_turn_with_its_gyro():
    """Correlation of the two yaw rates is greatest within one sample of no shift at all."""
    (record, *_) = read_log(log_path("husky_tile"), "husky_tile").records
    both = np.isfinite(record.twist[:, 1]) & np.isfinite(record.yaw_rate)
    wheels, gyro = record.twist[both, 1], record.yaw_rate[both]
    shifts = range(-6, 7)
    middle = slice(10, -10)
    fits = [np.corrcoef(np.roll(wheels, shift)[middle], gyro[middle])[0, 1] for shift in shifts]
    assert abs(shifts[int(np.argmax(fits))]) <= 1


@pytest.mark.real_logs
@pytest.mark.parametrize("terrain", ["asphalt", "gravel"])
def test_the_warthog_logs_are_read_step_by_step(terrain):
    log = read_log(log_path(f"warthog_{terrain}"), f"warthog_{terrain}")
    assert len(log.records) == 100
    assert sum(len(record.command) for record in log.records) == 12000
    assert log.findings == ()


@pytest.mark.real_logs
def test_the_gyro_on_gravel_is_upside_down_and_that_is_found():
    log = read_log(log_path("warthog_gravel"), "warthog_asphalt")
    assert [finding.kind for finding in log.findings] == ["wrong sign"]
