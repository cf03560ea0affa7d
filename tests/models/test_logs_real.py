"""Logs of real robots: reader, and identification with base effects."""

import os
from dataclasses import replace
from functools import cache
from itertools import chain, pairwise, product

import numpy as np
import pytest
from degraded_logs import FOLDERS, log_path

from diffdrive_mpc.models.identification.effects.fitting import fit_effects, weight_readings
from diffdrive_mpc.models.identification.effects.free_run import base_track, sensor_experiments
from diffdrive_mpc.models.identification.effects.selection import EFFECTS, LINEAR
from diffdrive_mpc.models.identification.effects.settings import effect_settings
from diffdrive_mpc.models.identification.fit.fitting import fit
from diffdrive_mpc.models.identification.log_data import divide, read_data
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.geometry import wheel_geometry
from diffdrive_mpc.models.logs.mapping import MAPPINGS, load_mapping
from diffdrive_mpc.models.output_error.experiment import join_experiments, twist_experiments
from diffdrive_mpc.models.output_error.validation import pooled_fit_percent, validate
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.models.structures.structure import IdentificationConditions
from oracle.second_order import fit_second_order, response


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
    has_both = np.isfinite(record.twist[:, 1]) & np.isfinite(record.yaw_rate)
    wheels, gyro = record.twist[has_both, 1], record.yaw_rate[has_both]
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


MIN_READINGS = identification_settings().min_readings
CUTS = ("at the step", "60 rows before", "anywhere")
# Each log and each cut once; DIFFDRIVE_MPC_ALL=1 runs all combinations.
EACH_ONCE = tuple(zip(FOLDERS, CUTS, strict=True))
CUT_CASES = tuple(product(FOLDERS, CUTS)) if "DIFFDRIVE_MPC_ALL" in os.environ else EACH_ONCE


def stretches(records, cut, past):
    """Cut the records into pieces and omit short pieces; without `past`, the pieces are not consecutive."""
    pieces = []
    for record in records:
        count = len(record.command)
        steps = np.flatnonzero(np.any(np.diff(record.command, axis=0) != 0, axis=1)) + 1
        edges = {
            "at the step": steps,
            "60 rows before": steps - 60,
            "anywhere": np.random.default_rng(count).choice(count, count // 120, replace=False),
        }[cut]
        edges = np.unique([0, *edges[(edges > 0) & (edges < count)], count]).tolist()
        pieces += [record.part(a, b) for a, b in pairwise(edges) if past or b - a > 30]
    # `identify` also omits these records.
    pieces = [p for p in pieces if min(p.fresh_twist.sum(), p.fresh_yaw_rate.sum()) >= MIN_READINGS]
    return pieces if past else [replace(piece, start=3600.0 * i) for i, piece in enumerate(pieces)]


@cache
def divide_log(log):
    """Return records to identify from and held-out records, divided as `identify` does."""
    records = read_log(log_path(log), log).records
    if len(records) < 10:  # seven minutes of one long record are sufficient
        records = (records[0].part(0, 8400),)
    return divide(records, 0.6)


@cache
def shipped_fit(log):
    train, held_out = divide_log(log)
    return validate(identify_sm(train, limits=False).system, held_out).fit_percent


@pytest.mark.long
@pytest.mark.real_logs
@pytest.mark.parametrize(("log", "cut"), CUT_CASES)
def test_cut_reduces_the_fit_by_less_than_three_points(log, cut):
    train, held_out = divide_log(log)
    fits = validate(identify_sm(stretches(train, cut, past=True), limits=False).system, held_out).fit_percent
    assert (fits > shipped_fit(log) - 3.0).all(), fits


@pytest.mark.real_logs
@pytest.mark.parametrize("log", FOLDERS)
def test_baseline_fit_is_not_better(log):
    assert (shipped_fit(log) > baseline_fit(*divide_log(log)) - 0.5).all()


@pytest.mark.real_logs
@pytest.mark.parametrize(("log", "cut"), CUT_CASES)
def test_fit_of_pieces_without_history_is_close_to_the_baseline(log, cut):
    train, held_out = divide_log(log)
    train = stretches(train, cut, past=False)
    fits = validate(identify_sm(train, limits=False).system, held_out).fit_percent
    assert (fits > baseline_fit(train, held_out) - 0.5).all(), fits


@pytest.mark.long
@pytest.mark.real_logs
@pytest.mark.parametrize("quarter", range(4))
@pytest.mark.parametrize("log", FOLDERS)
def test_no_structure_has_a_lower_fit_than_the_better_baseline(log, quarter):
    """Each quarter of the log is held out in turn; SSM explains its training rows as well as SM."""
    first_part, remaining = divide([*chain(*divide_log(log))], quarter / 4)
    held_out, last_part = divide(remaining, 1 / (4 - quarter))
    train = first_part + last_part
    conditions = IdentificationConditions(wheel_radius=wheel_geometry(train).radius)
    models = [STRUCTURES[name].identify(train, conditions).identified for name in ("sm", "mbm_modes", "ssm")]
    fits = np.array([validate(model.system, held_out).fit_percent for model in models])
    for clip in (False, True):
        assert (fits > baseline_fit(train, held_out, clip) - 0.5).all(), fits
    gain = np.subtract(*(validate(model.system, train).fit_percent for model in models[::-2]))
    assert gain.mean() > -1e-3 and gain.min() > -0.1, gain


ENCODER_TRACK = 0.480865


@pytest.fixture(scope="module")
def husky():
    """Linear fit and fit with effects of five minutes, and the next two minutes as held-out data."""
    record = read_log(log_path("husky_tile"), "husky_tile").records[0]
    parts = [record.part(0, 6000), record.part(6000, 8400)]
    train, held_out = (weight_readings(sensor_experiments([part])) for part in parts)
    initial = {name: values[2] for name, values in effect_settings().parameters.items()}
    linear = fit_effects({name: initial[name] for name in LINEAR} | {"encoders.track": ENCODER_TRACK}, LINEAR, train)
    effect_parameters = [
        name for effect in ("twist slew", "lag of the encoders", "yaw relaxation") for name in EFFECTS[effect]
    ]
    start = {**linear.point, **{name: initial[name] for name in effect_parameters}}
    return linear, fit_effects(start, [*LINEAR, *effect_parameters], train), held_out


@pytest.mark.real_logs
def test_slew_of_husky_agrees_with_its_configuration(husky):
    """The maximum acceleration is 2.0 rad/s^2 in husky_control/config/control.yaml."""
    assert husky[1].point["slew.omega"] == pytest.approx(2.0, abs=0.06)


@pytest.mark.real_logs
def test_track_of_husky_agrees_with_its_configuration(husky):
    """The wheel separation is 0.512 m in husky_control/config/control.yaml."""
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
        divide_log = [tuple(replace(record, **removed) for record in part) for part in (data.train, data.validation)]
        data = replace(data, train=divide_log[0], validation=divide_log[1], yaw="gyro" if gyro else "encoders")
        plain, with_effects = (fit(data, STRUCTURES["sm"], effects=on) for on in (False, True))
        fits = [fitted.validation.fit_percent for fitted in (plain, with_effects)]
        assert (fits[1] > fits[0] - 1.0).all(), fits


def baseline_fit(train, held_out, clip=False):
    """Return the (2,) FIT [%] on the held-out records of the baseline identified from `train`."""
    fits = []
    for row in (0, 1):
        training, validation = (
            [s.channel(row, row) for s in join_experiments(twist_experiments(part))] for part in (train, held_out)
        )
        u, y, c = zip(*((s.inputs[:, 0], s.outputs[:, 0], s.counts[:, 0]) for s in training), strict=True)
        baseline = fit_second_order(u, y, c, training[0].dt, clip)
        firsts = [s.outputs[np.argmax(s.counts), 0] for s in validation]
        runs = [response(baseline, s.inputs[:, 0], f, s.dt) for s, f in zip(validation, firsts, strict=True)]
        masks = [s.counts[:, 0] for s in validation]
        measured = [s.outputs[k, 0] for s, k in zip(validation, masks, strict=True)]
        fits.append(pooled_fit_percent(measured, [r[k] for r, k in zip(runs, masks, strict=True)]))
    return np.array(fits)
