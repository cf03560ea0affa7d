"""SM, SSM and MBM estimate the robot of a log within their stated uncertainty."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from identification_parts import DT, noisy_drive, published_ssm, record, set_points, two_channels
from limit_population import drawn_record

from diffdrive_mpc.models.identification.log_data import divide
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.check_settings import check_settings
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.logs.sampling import RawStretch, Signal, resample
from diffdrive_mpc.models.output_error.experiment import twist_experiments
from diffdrive_mpc.models.output_error.statistics import effective_samples, long_run_covariance
from diffdrive_mpc.models.output_error.validation import validate
from diffdrive_mpc.models.structures.channel import identify_channel
from diffdrive_mpc.models.structures.mbm import identify_mbm
from diffdrive_mpc.models.structures.orders import compare_orders
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.models.structures.ssm import choose_order, identify_ssm
from diffdrive_mpc.models.structures.structure import IdentificationConditions

SM = two_channels((0.95, 10.0, 1.3), (0.7, 7.0, 0.7), dead_time=(0.053, 0.031))
SM_TRUTH = {
    f"{channel}.{name}": value
    for channel, values in (("v", (0.95, 10.0, 1.3, 0.053)), ("omega", (0.7, 7.0, 0.7, 0.031)))
    for name, value in zip(("gain", "natural_frequency", "damping", "dead_time"), values, strict=True)
}


def check_agreement(parameters, truth, within=4.0):
    for name, value in truth.items():
        error = abs(parameters.value(name) - value) / parameters.deviation(name)
        assert error < within, f"{name}: {error:.1f} standard deviations"


@pytest.fixture(scope="module")
def single_fit():
    """Drive and the parameters identified from it as a single record."""
    drive = noisy_drive(SM, 2, count=1960)
    return drive, identify_sm([drive], limits=False).parameters


def test_split_or_shifted_log_gives_the_same_model(single_fit):
    drive, single = single_fit
    parts = [drive.part(0, 1100), drive.part(1100, 1960)]
    shifted_record = Record("moved", drive.start + 1e4, DT, drive.command, twist=drive.twist, yaw_rate=drive.yaw_rate)
    split, shifted = (identify_sm(records, limits=False).parameters for records in (parts, [shifted_record]))
    assert shifted.values.tolist() == single.values.tolist()
    assert split.values.tolist() == single.values.tolist()


@pytest.mark.parametrize("offset", [0, 37])
def test_stretches_without_history_give_the_same_model(offset, single_fit):
    """Cut the record at or before every step of the command, and reverse the order of the parts."""
    drive, single = single_fit
    edges = [0, *range(40 + offset, 1960, 120), 1960]
    split = identify_sm([drive.part(*ends) for ends in pairwise(edges)][::-1], limits=False).parameters
    # A third of the commands before a step is missing, which reduces the information.
    assert np.abs((split.values - single.values) / split.standard_deviation).max() < 3.0


def test_outliers_hardly_change_the_model():
    clean = noisy_drive(SM, 3)
    twist = clean.twist.copy()
    twist[np.random.default_rng(0).integers(0, len(twist), 60), 0] += 2.0
    with_outliers = Record("spoilt", 0.0, DT, clean.command, twist=twist, yaw_rate=clean.yaw_rate)
    robust, least_squares = (
        identify_sm([with_outliers], limits=False, robust=is_robust).parameters for is_robust in (True, False)
    )
    check_agreement(robust, SM_TRUTH)
    assert robust.deviation("v.gain") < 0.5 * least_squares.deviation("v.gain")


def test_only_fresh_readings_are_used():
    """Encoders have a fifth of the rate; the values between their readings are NaN."""
    full = noisy_drive(SM, 4)
    fresh = np.arange(len(full.command)) % 5 == 0
    twist = np.where(fresh[:, None], full.twist, np.nan)
    slow_record = Record("slow", 0.0, DT, full.command, twist=twist, yaw_rate=full.yaw_rate, fresh_twist=fresh)
    parameters = identify_sm([slow_record], limits=False).parameters
    check_agreement(parameters, SM_TRUTH)
    assert parameters.deviation("v.gain") > 1.5 * identify_sm([full], limits=False).parameters.deviation("v.gain")


def test_gyro_bias_is_distinguished_from_a_turn():
    drive = noisy_drive(SM, 5)
    biased = Record("biased", 0.0, DT, drive.command, twist=drive.twist, yaw_rate=drive.yaw_rate + 0.04)
    parameters = identify_sm([biased], limits=False).parameters
    check_agreement(parameters, {**SM_TRUTH, "omega.offset": 0.04})


def test_coloured_noise_has_fewer_effective_samples():
    stream = np.random.default_rng(0)
    white = stream.normal(size=(20000, 1))
    coloured = np.zeros_like(white)
    for k in range(1, len(white)):
        coloured[k] = 0.8 * coloured[k - 1] + 0.6 * white[k]
    # A first-order process with correlation rho has a long-run variance of (1 + rho) / (1 - rho) times its variance.
    assert effective_samples([coloured])[0] == pytest.approx(20000 / 9, rel=0.2)
    # 302 cosines estimate a variance within 8 %.
    assert effective_samples([white])[0] > 16000
    # Rows without readings between the readings do not change the result.
    thirds = np.zeros((60000, 1))
    thirds[::3] = coloured
    assert long_run_covariance([thirds[:21000], thirds[21000:]])[0] == pytest.approx(long_run_covariance([coloured])[0])


def test_limit_of_the_base_is_identified():
    limited, free = (noisy_drive(SM, 7, count=1500, limit=limit) for limit in (0.9, np.inf))
    identified = identify_sm([limited])
    assert set(identified.limits) == {"omega"}
    check_agreement(identified.parameters, {**SM_TRUTH, "omega.left": 0.9, "omega.right": 0.9})
    assert identify_sm([free]).limits == {}


def test_unobservable_fast_pole_gives_a_doubt():
    lag = two_channels((1.0, 80.0, 5.5), (1.0, 7.0, 0.7))
    experiments = [s.channel(0, 0) for s in twist_experiments([noisy_drive(lag, 8, count=1500)])]
    doubts = identify_channel(experiments, "v", limit=False).warnings
    assert {doubt.kind for doubt in doubts} == {"divided lag"}


def test_ssm_recovers_the_published_model():
    model = published_ssm()
    drive = noisy_drive(model, 14)
    identified = identify_ssm([drive.part(0, 1400), drive.part(1500, 3000)], 2, limits=False)
    gain, poles = model.dc_gain, sorted(model.poles.real, reverse=True)
    truth = {
        "gain.v_ref_to_v": gain[0, 0],
        "gain.omega_ref_to_v": gain[0, 1],
        "gain.v_ref_to_omega": gain[1, 0],
        "gain.omega_ref_to_omega": gain[1, 1],
        "pole_1": poles[0],
        "pole_2": poles[1],
        "dead_time.v": 0.043,
        "dead_time.omega": 0.052,
    }
    check_agreement(identified.parameters, truth)
    assert identified.model.dc_gain == pytest.approx(gain, abs=0.02)


@pytest.fixture(scope="module")
def models_by_order():
    """Drive of the published SSM, and models of orders 1 to 4 identified from this drive."""
    drive = noisy_drive(published_ssm(), 15, count=1000)
    return drive, [row.identified for row in choose_order([drive], max_order=4, limits=False, requested=4).rows]


def test_order_two_is_selected_for_a_second_order_robot(models_by_order):
    (train, models), held_out = models_by_order, noisy_drive(published_ssm(), 16, count=700)
    choice = compare_orders(models, [train], [held_out], "gyro", requested=None)
    assert choice.order == 2
    reversed_record = replace(held_out, twist=-held_out.twist)
    repeated = compare_orders(models, [train], [reversed_record], "gyro", requested=None)
    assert repeated.order == 2  # validation rows do not affect the choice
    for row, repeated_row in zip(choice.rows, repeated.rows, strict=True):
        np.testing.assert_array_equal(row.block_fit_percent, repeated_row.block_fit_percent)
        assert row.validation_fit_percent[0] > repeated_row.validation_fit_percent[0] + 50
    fits = [row.train_fit_percent.mean() for row in choice.rows]
    assert fits[0] < fits[1] - 10
    assert [row.parameters for row in choice.rows] == [4 + 3, 8 + 3, 12 + 3, 16 + 3]


@pytest.mark.parametrize(("has_four_wheels", "limit"), [(True, np.inf), (False, 0.4)])
def test_mbm_recovers_motors_both_tracks_and_a_limit(has_four_wheels, limit):
    radius, firmware, effective = 0.07, 0.4, 0.62
    commands = set_points(17, 2000, (0.6, 1.2))
    motors = [(0.95, 12.0, 0.9), (1.02, 10.0, 1.2)]
    rims = np.clip(commands, [-limit, -np.inf], [limit, np.inf]) @ np.array([[1.0, 1.0], [-firmware / 2, firmware / 2]])
    motor_speeds = two_channels(*motors, dead_time=(0.047, 0.047)).discretise(DT).simulate(rims / radius)
    yaw_rate = radius * (motor_speeds[:, 1] - motor_speeds[:, 0]) / effective
    stream = np.random.default_rng(18)
    wheels = motor_speeds + 0.1 * stream.normal(size=motor_speeds.shape)
    twist = np.column_stack([radius * wheels.mean(axis=1), yaw_rate])
    drive = Record(
        "drive",
        0.0,
        DT,
        commands,
        twist=twist,
        yaw_rate=yaw_rate + 0.02 * stream.normal(size=len(yaw_rate)),
        wheels=wheels,
        wheel_speeds=np.tile(motor_speeds, 2) + 0.1 * stream.normal(size=(2000, 4)) if has_four_wheels else None,
    )
    identified = identify_mbm([drive], radius)
    limits = {} if np.isinf(limit) else {"v": limit}
    assert identified.limits.keys() == limits.keys()
    truth = {"firmware_track": firmware, "v.dead_time": 0.047, "omega.dead_time": 0.047} | {
        f"v.{side}": limits["v"] for side in ("forward", "reverse") if limits
    }
    for side, motor in zip(("left", "right"), motors, strict=True):
        for name, value in zip(("gain", "natural_frequency", "damping"), motor, strict=True):
            truth |= {f"{axle}_{side}.{name}": value for axle in (("front", "rear") if has_four_wheels else ("front",))}
    check_agreement(identified.parameters, truth)
    assert identified.parameters.value("effective_track") == pytest.approx(effective, rel=0.02)
    assert identified.model.order == 8


@pytest.mark.long
def test_mbm_by_modes_recovers_motors_of_a_robot_that_turns_more_slowly_than_it_drives():
    drive, gains, track, radius = noisy_drive(SM, 21, count=2000), {"front_left": 0.97, "front_right": 1.03}, 0.5, 0.07
    rims = drive.twist @ np.array([[1.0, 1.0], [-track / 2, track / 2]]) * list(gains.values())
    drive = replace(drive, twist=np.column_stack([rims.mean(axis=1), drive.twist[:, 1]]), wheels=rims / radius)
    train, held_out = [drive.part(0, 1300)], [drive.part(1300, 2000)]
    modes, motors = (
        STRUCTURES[name].identify(train, IdentificationConditions(wheel_radius=radius)).identified
        for name in ("mbm_modes", "mbm")
    )
    truth = {f"{motor}.gain": gain for motor, gain in gains.items()}
    check_agreement(modes.parameters, SM_TRUTH | truth | {"effective_track": track})
    fits = [validate(model.system, held_out).fit_percent for model in (modes, motors, identify_sm(train))]
    # v follows from both commands; omega has the same model as in SM.
    assert (fits[0] > np.maximum(fits[1] + [0.2, 5.0], fits[2] - [0.0, 1e-3])).all()


def test_invalid_input_raises_value_error_with_the_reason():
    drive = noisy_drive(SM, 20, count=200)
    with pytest.raises(ValueError, match="no yaw_rate"):
        identify_sm([Record("mute", 0.0, DT, drive.command, twist=drive.twist)])
    with pytest.raises(ValueError, match="never changes"):
        identify_sm([record(np.ones((100, 2)), drive.twist[:100])])
    with pytest.raises(ValueError, match="check that the sensor is connected"):
        identify_sm([record(drive.command, np.zeros((200, 2)))])


SPIKE_MODEL = two_channels((0.95, 10.0, 1.3), (0.7, 7.0, 0.7))


def with_spikes(drive, size):
    """Add an outlier of up to `size` to one reading in a hundred of each sensor."""
    stream = np.random.default_rng(3)
    twist, yaw_rate = drive.twist.copy(), drive.yaw_rate.copy()
    for column in (twist[:, 0], yaw_rate):
        rows = stream.choice(len(column), len(column) // 100, replace=False)
        column[rows] += size * stream.uniform(0.5, 1.0, len(rows)) * stream.choice([-1, 1], len(rows))
    return Record("spiked", 0.0, DT, drive.command, twist=twist, yaw_rate=yaw_rate)


def write_and_read(drive, folder):
    """Write the drive to a log and read the log."""
    table = np.column_stack((drive.command, drive.twist, drive.yaw_rate))
    np.savetxt(folder / "log.csv", table, delimiter=",", header="v,w,ev,ew,gz", comments="")
    (folder / "map.yaml").write_text(
        f"columns:\n  sample_time: {DT}\n  command: {{v: v, omega: w}}\n"
        "  encoders: {v: ev, omega: ew}\n  gyro: {yaw_rate: gz}\n"
    )
    log = read_log(folder / "log.csv", folder / "map.yaml")
    return list(log.records), [finding for finding in log.findings if finding.kind == "spikes"]


@pytest.mark.long
@pytest.mark.parametrize("size", [5.0, 1000.0])
def test_one_outlier_in_a_hundred_readings_does_not_worsen_the_model(size, tmp_path):
    clean = noisy_drive(SPIKE_MODEL, 5)
    records, findings = write_and_read(with_spikes(clean, size), tmp_path)
    assert [finding.severity for finding in findings] == ["warning", "warning"]
    assert "(1 %)" in findings[1].message
    reference, identified = (identify_sm(part, limits=False) for part in ([clean], records))
    assert validate(identified.system, [clean]).fit_percent == pytest.approx(
        validate(reference.system, [clean]).fit_percent, abs=0.3
    )
    assert validate(identified.system, records).fit_percent.min() > 85.0


@pytest.mark.parametrize("seed", range(5))
def test_clean_drive_has_no_spikes(seed, tmp_path):
    assert write_and_read(noisy_drive(SPIKE_MODEL, seed), tmp_path)[1] == []


def test_uneven_command_times_do_not_shorten_the_dead_time():
    """At 20 Hz with 8 ms of jitter, using only the active command at each grid point would lose 16 ms."""
    period, fine, seconds, rng = 0.05, 0.001, 80.0, np.random.default_rng(0)
    count = int(seconds / period)
    times, read = period * np.arange(count) + np.clip(rng.normal(0, 0.008, (2, count)), -0.02, 0.02) + 0.03
    commands, grid = set_points(1, count, (0.8, 1.5), 12), np.arange(0, seconds + 1, fine)
    twist = SM.discretise(fine).simulate(commands[np.clip(np.searchsorted(times, grid, side="right") - 1, 0, None)])
    readings = twist[np.searchsorted(grid, read)] + rng.normal(0, (0.01, 0.03), (count, 2))
    signals = {"twist": Signal(read, readings), "yaw_rate": Signal(read, readings[:, 1:])}
    even = resample("log", RawStretch(times, Signal(times, commands), signals), 0.0, seconds, period, check_settings())
    parameters = identify_sm([even], limits=False).parameters
    for channel in ("v", "omega"):
        lags = [
            read(f"{channel}.dead_time") + 2 * read(f"{channel}.damping") / read(f"{channel}.natural_frequency")
            for read in (parameters.value, SM_TRUTH.get)
        ]
        assert lags[0] == pytest.approx(lags[1], abs=0.005)


@pytest.mark.system
@pytest.mark.parametrize("seed", [pytest.param(2104, marks=pytest.mark.long), 8106])
def test_ssm_explains_its_training_rows_at_least_as_well_as_sm_and_predicts_others(seed):
    records, held_out = divide([drawn_record(seed)], 0.6)
    models = choose_order(records).identified, identify_sm(records)
    gain = np.subtract(*(validate(model.system, records).fit_percent for model in models))
    assert gain.mean() > -1e-3 and gain.min() > -0.1
    assert np.subtract(*(validate(model.system, held_out).fit_percent for model in models)).min() > -0.5


def test_ssm_of_two_independent_channels_is_sm():
    """SM has the fewest parameters that describe such a robot, so it predicts held-out blocks best."""
    drive = noisy_drive(two_channels((1.0, 8.0, 0.8), (1.0, 7.0, 0.9), dead_time=(0.06, 0.1)), 19, count=900)
    choice = choose_order([drive], max_order=4, limits=False)
    assert choice.order == 4 and choice.reason.startswith("SM as a state space")


def test_order_with_a_fit_below_the_floor_is_not_chosen(models_by_order):
    drive, models = models_by_order
    floor = validate(models[3].system, [drive]).fit_percent
    free, above = (compare_orders(models, [drive], [], "gyro", floor=limit).order for limit in (None, floor))
    assert free < above
