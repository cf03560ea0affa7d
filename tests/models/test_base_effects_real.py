"""Base effects on logs of real robots."""

import os
from dataclasses import replace

import numpy as np
import pytest
from real_log_files import FOLDERS, log_path

from diffdrive_mpc.models.identification.effects.fitting import fit_effects, weighted
from diffdrive_mpc.models.identification.effects.free_run import base_track, sensed
from diffdrive_mpc.models.identification.effects.selection import EFFECTS, LINEAR
from diffdrive_mpc.models.identification.effects.settings import effect_settings
from diffdrive_mpc.models.identification.fit.fitting import fit
from diffdrive_mpc.models.identification.log_data import read_data
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.structures.registry import STRUCTURES

pytestmark = pytest.mark.real_logs
ENCODER_TRACK = 0.480865


@pytest.fixture(scope="module")
def husky():
    """Five minutes to fit, and the two after them."""
    record = read_log(log_path("husky_tile"), "husky_tile").records[0]
    parts = [record.part(0, 6000), record.part(6000, 8400)]
    train, held_out = (weighted(sensed([part])) for part in parts)
    guess = {name: low_high_guess[2] for name, low_high_guess in effect_settings().parameters.items()}
    linear = fit_effects({name: guess[name] for name in LINEAR} | {"encoders.track": ENCODER_TRACK}, LINEAR, train)
    more = [name for effect in ("twist slew", "lag of the encoders", "yaw relaxation") for name in EFFECTS[effect]]
    start = {**linear.point, **{name: guess[name] for name in more}}
    return linear, fit_effects(start, [*LINEAR, *more], train), held_out


def test_the_husky_slews_as_its_configuration_says(husky):
    """max_acceleration 2.0 rad/s^2 of the base's controller (husky_control/config/control.yaml)."""
    assert husky[1].point["slew.omega"] == pytest.approx(2.0, abs=0.06)


def test_the_huskys_gains_give_the_track_of_its_configuration(husky):
    """wheel_separation 0.512 m, in the same file."""
    assert base_track(husky[1].point) == pytest.approx(0.512, abs=0.015)


def test_effects_halve_the_error_power_of_omega_on_rows_held_out(husky):
    linear, effects, held_out = husky
    power = [np.nansum(np.concatenate(held_out.errors(fit.point)) ** 2, axis=0) for fit in (linear, effects)]
    assert (power[1][1:] < 0.5 * power[0][1:]).all(), power


# Twenty minutes: DIFFDRIVE_MPC_ALL=1 pytest tests/models/test_base_effects_real.py
if "DIFFDRIVE_MPC_ALL" in os.environ:

    @pytest.mark.parametrize("track", [True, False], ids=["track", "no track"])
    @pytest.mark.parametrize("gyro", [True, False], ids=["gyro", "no gyro"])
    @pytest.mark.parametrize("log", FOLDERS)
    def test_with_effects_no_row_held_out_is_predicted_worse(log, gyro, track):
        data = read_data([log_path(log)], [], mapping=log, fit_share=0.6, wheels=False, on_findings=lambda _: None)
        gone = {} if track else {"wheels": None, "wheel_speeds": None}
        gone |= {} if gyro else {"yaw_rate": None, "fresh_yaw_rate": None}
        halves = [tuple(replace(record, **gone) for record in half) for half in (data.train, data.validation)]
        data = replace(data, train=halves[0], validation=halves[1], yaw="gyro" if gyro else "encoders")
        plain, found = (fit(data, STRUCTURES["sm"], effects=on) for on in (False, True))
        fits = [one.validation.fit_percent for one in (plain, found)]
        assert (fits[1] > fits[0] - 1.0).all(), fits
