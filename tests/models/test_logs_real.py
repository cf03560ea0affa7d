"""Logs of real robots: reading, and identification with the effects of their bases."""

import os
from dataclasses import replace

import numpy as np
import pytest
from degraded_logs import FOLDERS, log_path

from diffdrive_mpc.models.identification.effects.fitting import fit_effects, weight_readings
from diffdrive_mpc.models.identification.effects.free_run import base_track, sensor_experiments
from diffdrive_mpc.models.identification.effects.selection import EFFECTS, LINEAR
from diffdrive_mpc.models.identification.effects.settings import effect_settings
from diffdrive_mpc.models.identification.fit.fitting import fit
from diffdrive_mpc.models.identification.log_data import read_data
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.mapping import MAPPINGS, load_mapping
from diffdrive_mpc.models.structures.registry import STRUCTURES


@pytest.mark.parametrize("name", [path.stem for path in sorted(MAPPINGS.glob("*.yaml"))])
def test_shipped_mapping_has_a_source(name):
    assert load_mapping(name).source


@pytest.mark.real_logs
def test_husky_log_has_three_stretches():
    log = read_log(log_path("husky_tile"), "husky_tile")
    assert [round(record.end - record.start) for record in log.records] == [653, 30, 526]
    assert [finding.kind for finding in log.findings] == ["gap", "gap"]
    assert all(record.dt == 0.05 for record in log.records)


@pytest.mark.real_logs
def test_encoders_and_poses_of_husky_have_half_the_rate():
    (record, *_) = read_log(log_path("husky_tile"), "husky_tile").records
    assert 0.45 < record.fresh_twist.mean() < 0.6
    assert 0.45 < record.fresh_pose.mean() < 0.6
    assert record.fresh_yaw_rate.mean() > 0.95


@pytest.mark.real_logs
def test_encoders_and_gyro_of_husky_are_aligned_after_the_delay_in_the_mapping():
    """The correlation of the yaw rates is maximal for a shift of at most one sample."""
    (record, *_) = read_log(log_path("husky_tile"), "husky_tile").records
    both = np.isfinite(record.twist[:, 1]) & np.isfinite(record.yaw_rate)
    wheels, gyro = record.twist[both, 1], record.yaw_rate[both]
    shifts = range(-6, 7)
    middle = slice(10, -10)
    fits = [np.corrcoef(np.roll(wheels, shift)[middle], gyro[middle])[0, 1] for shift in shifts]
    assert abs(shifts[int(np.argmax(fits))]) <= 1


@pytest.mark.real_logs
@pytest.mark.parametrize("terrain", ["asphalt", "gravel"])
def test_each_step_of_the_warthog_logs_is_a_record(terrain):
    log = read_log(log_path(f"warthog_{terrain}"), f"warthog_{terrain}")
    assert len(log.records) == 100
    assert sum(len(record.command) for record in log.records) == 12000
    assert log.findings == ()


@pytest.mark.real_logs
def test_inverted_gyro_on_gravel_is_detected():
    log = read_log(log_path("warthog_gravel"), "warthog_asphalt")
    assert [finding.kind for finding in log.findings] == ["wrong sign"]


ENCODER_TRACK = 0.480865


@pytest.fixture(scope="module")
def husky():
    """Linear fit and fit with effects of five minutes, and the next two minutes as held-out data."""
    record = read_log(log_path("husky_tile"), "husky_tile").records[0]
    parts = [record.part(0, 6000), record.part(6000, 8400)]
    train, held_out = (weight_readings(sensor_experiments([part])) for part in parts)
    guess = {name: low_high_guess[2] for name, low_high_guess in effect_settings().parameters.items()}
    linear = fit_effects({name: guess[name] for name in LINEAR} | {"encoders.track": ENCODER_TRACK}, LINEAR, train)
    effect_parameters = [
        name for effect in ("twist slew", "lag of the encoders", "yaw relaxation") for name in EFFECTS[effect]
    ]
    start = {**linear.point, **{name: guess[name] for name in effect_parameters}}
    return linear, fit_effects(start, [*LINEAR, *effect_parameters], train), held_out


@pytest.mark.real_logs
def test_slew_of_husky_agrees_with_its_configuration(husky):
    """max_acceleration 2.0 rad/s^2 of the base's controller (husky_control/config/control.yaml)."""
    assert husky[1].point["slew.omega"] == pytest.approx(2.0, abs=0.06)


@pytest.mark.real_logs
def test_track_of_husky_agrees_with_its_configuration(husky):
    """wheel_separation 0.512 m, in the same file."""
    assert base_track(husky[1].point) == pytest.approx(0.512, abs=0.015)


@pytest.mark.real_logs
def test_effects_halve_the_held_out_error_power_of_omega(husky):
    linear, effects, held_out = husky
    power = [np.nansum(np.concatenate(held_out.errors(fit.point)) ** 2, axis=0) for fit in (linear, effects)]
    assert (power[1][1:] < 0.5 * power[0][1:]).all(), power


# Twenty minutes: DIFFDRIVE_MPC_ALL=1 pytest tests/models/test_logs_real.py
if "DIFFDRIVE_MPC_ALL" in os.environ:

    @pytest.mark.real_logs
    @pytest.mark.parametrize("track", [True, False], ids=["track", "no track"])
    @pytest.mark.parametrize("gyro", [True, False], ids=["gyro", "no gyro"])
    @pytest.mark.parametrize("log", FOLDERS)
    def test_effects_do_not_worsen_the_held_out_prediction(log, gyro, track):
        data = read_data([log_path(log)], [], mapping=log, fit_share=0.6, wheels=False, on_findings=lambda _: None)
        removed = {} if track else {"wheels": None, "wheel_speeds": None}
        removed |= {} if gyro else {"yaw_rate": None, "fresh_yaw_rate": None}
        halves = [tuple(replace(record, **removed) for record in half) for half in (data.train, data.validation)]
        data = replace(data, train=halves[0], validation=halves[1], yaw="gyro" if gyro else "encoders")
        plain, with_effects = (fit(data, STRUCTURES["sm"], effects=on) for on in (False, True))
        fits = [fitted.validation.fit_percent for fitted in (plain, with_effects)]
        assert (fits[1] > fits[0] - 1.0).all(), fits
