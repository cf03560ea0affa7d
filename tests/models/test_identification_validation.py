"""Validation and files of identified models."""

import datetime
from dataclasses import replace

import numpy as np
import pytest
from identification_parts import DT, noisy_drive, published_ssm, record, set_points, single, system, two_channels

from diffdrive_mpc import integrate_pose, load_model
from diffdrive_mpc.models.identification.fit.poses import pose_drift
from diffdrive_mpc.models.load import read_model_file
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.state_space import LinearSystem
from diffdrive_mpc.models.output_error.validation import (
    check_residuals,
    fit_percent,
    pooled_fit_percent,
    simulate_experiment,
    simulate_records,
    validate,
)
from diffdrive_mpc.models.structures.channel import identify_channel
from diffdrive_mpc.models.structures.identified import model_file, write_model_file
from diffdrive_mpc.models.structures.mbm import identify_mbm
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.models.structures.ssm import identify_ssm
from diffdrive_mpc.models.structures.two_poles import TwoPolesForm
from diffdrive_mpc.models.wheels import WheelKinematics
from studies.shipped_models.model_fitting import identify_track, side_difference

MODEL = published_ssm()


def test_fit_is_computed_from_a_free_run_that_starts_at_the_first_reading():
    drive = noisy_drive(MODEL, 1)
    drives = [drive.part(0, 1400), drive.part(1500, 3000)]
    validation = validate(system(MODEL), drives)
    simulated = simulate_records(system(MODEL), drives)
    for row, measured in enumerate(("twist", "yaw_rate")):
        y = np.concatenate([getattr(r, measured).reshape(len(r.command), -1)[:, 0] for r in drives])
        yhat = np.concatenate([outputs[:, row] for outputs in simulated])
        assert validation.fit_percent[row] == pytest.approx(fit_percent(y, yhat))
        assert validation.rmse[row] == pytest.approx(np.sqrt(np.mean((y - yhat) ** 2)))
    for outputs, r in zip(simulated, drives, strict=True):
        assert outputs[0] == pytest.approx([r.twist[0, 0], r.yaw_rate[0]])


def test_limit_and_offset_are_part_of_the_prediction():
    drive = noisy_drive(MODEL, 2, limit=0.6, noise=(0.0, 0.0))
    partial = system(MODEL)
    complete = LinearSystem(*partial[:4], np.array([0.0, 0.05]), np.array([[np.inf] * 4, [0.6, 0.6, np.inf, np.inf]]))
    drive = record(drive.command, drive.twist + [0.0, 0.05])
    assert validate(complete, [drive]).fit_percent.min() > 99.0
    assert validate(partial, [drive]).fit_percent[1] < 80.0


def test_white_residuals_pass_and_coloured_residuals_do_not():
    white = noisy_drive(MODEL, 3)
    stream = np.random.default_rng(4)
    noise = np.zeros((3000, 2))
    for k in range(1, 3000):
        noise[k] = 0.6 * noise[k - 1] + 0.01 * stream.normal(size=2)
    clean = MODEL.discretise(DT).simulate(white.command)
    good, bad = (validate(system(MODEL), [r]).residuals for r in (white, record(white.command, clean + noise)))
    # The run starts at the first, noisy reading: a short transient that the whiteness test tolerates.
    assert good.ljung_box_p.min() > 1e-3
    assert bad.ljung_box_p.max() < 1e-9
    assert bad.autocorrelation[:, 1] == pytest.approx([0.6, 0.6], abs=0.05)
    is_within = np.abs(good.autocorrelation[:, 1:]) < good.whiteness_bound
    assert is_within.mean() > 0.9
    assert good.autocorrelation[:, 0] == pytest.approx([1.0, 1.0])


def test_whiteness_bound_uses_the_output_with_fewer_readings():
    """The yaw rate has a quarter of the readings of the speed; about 95 of 100 lags are within the bound."""
    errors = np.random.default_rng(6).normal(size=(4000, 2))
    errors[np.arange(4000) % 4 > 0, 1] = np.nan
    check = check_residuals([errors], [single(np.random.default_rng(7).normal(size=(4000, 2)), np.zeros((4000, 2)))])
    assert check.whiteness_bound == pytest.approx(1.96 / np.sqrt(1000), rel=1e-3)
    # Only lags between two readings have pairs.
    is_within = np.abs(check.autocorrelation[1, 4::4]) < check.whiteness_bound
    assert is_within.mean() > 0.9


def test_residuals_of_a_wrong_model_are_correlated_with_the_command():
    drive = noisy_drive(MODEL, 5)
    wrong = published_ssm(dead_time=(0.043, 0.152))
    good, bad = (validate(system(m), [drive]).residuals.unexplained for m in (MODEL, wrong))
    assert good.max() < 2.5
    assert bad[1, 1] > 2 * good[1, 1]
    assert bad[1, 1] > bad[1, 0]


def test_reported_correlation_is_the_maximum_over_all_lags():
    """The residual follows only one command, twenty samples later."""
    drive = noisy_drive(MODEL, 6, noise=(0.0, 0.0))
    echo = np.zeros_like(drive.twist)
    echo[20:, 0] = 0.1 * drive.command[:-20, 0]
    residuals = validate(system(MODEL), [record(drive.command, drive.twist + echo)]).residuals
    correlation = np.abs(residuals.cross_correlation[0, 0, residuals.cross_correlation.shape[2] // 2 :])
    assert correlation.argmax() == 20
    assert correlation[20] == pytest.approx(1.0, abs=0.05)
    assert residuals.unexplained[0, 0] * residuals.cross_bound[0, 0] == pytest.approx(correlation[20])


def driven_record(twist, lever_arm=(0.0, 0.0), lag=0):
    """Build a record whose poses follow `twist` (K, 2) exactly, for a delayed sensor off the centre."""
    poses = [np.zeros(3)]
    for v, omega in 0.5 * (twist[1:] + twist[:-1]):
        poses.append(integrate_pose(poses[-1], v, omega, DT, 0.1))
    pose = np.array(poses)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    ahead, left = lever_arm
    pose = pose + np.column_stack([ahead * c - left * s, ahead * s + left * c, 0 * c])
    return record(twist, twist, pose=pose[np.maximum(np.arange(len(pose)) - lag, 0)])


def test_exact_twist_does_not_drift():
    twist = set_points(6, 1500, (0.5, 1.0))
    settings = {"lever_arm": (0.146, 0.02), "side_slip": 0.1, "horizons": (1.0, 5.0)}
    exact = pose_drift([driven_record(twist, (0.146, 0.02))], [twist], **settings)
    assert [drift.horizon for drift in exact] == [1.0, 5.0]
    assert max(drift.position_rmse for drift in exact) < 1e-9
    assert max(drift.heading_rmse for drift in exact) < 1e-9
    delayed = pose_drift([driven_record(twist, (0.146, 0.02), lag=5)], [twist], pose_lag=5 * DT, **settings)
    assert max(drift.position_rmse for drift in delayed) < 1e-9


def test_slow_poses_between_the_seconds_give_the_drift():
    twist = set_points(6, 1500, (0.5, 1.0))
    slow_record = replace(driven_record(twist), fresh_pose=np.arange(1500) % 11 == 5)
    drifts = pose_drift([slow_record], [twist], side_slip=0.1)
    assert [drift.starts for drift in drifts] == [29, 28, 25, 20]
    assert max(drift.position_rmse for drift in drifts) < 1e-9


def test_drift_of_a_speed_error_grows_in_proportion_to_time():
    twist = np.tile([0.5, 0.0], (1500, 1))
    drifts = pose_drift([driven_record(twist)], [1.02 * twist])
    assert [drift.position_rmse for drift in drifts] == pytest.approx([0.01, 0.02, 0.05, 0.1])
    assert [drift.starts for drift in drifts] == [29, 28, 25, 20]


DRIVE = noisy_drive(published_ssm(), 21, count=800, limit=0.9)
WHEELS = DRIVE.twist @ np.array([[1.0, 1.0], [-0.2, 0.2]]) / 0.07
WITH_WHEELS = Record("wheels", 0.0, DRIVE.dt, DRIVE.command, twist=DRIVE.twist, yaw_rate=DRIVE.yaw_rate, wheels=WHEELS)
IDENTIFY = {
    "mbm": lambda: identify_mbm([WITH_WHEELS], 0.07),
    "sm": lambda: identify_sm([DRIVE]),
    "ssm": lambda: identify_ssm([DRIVE], 2),
}


def write_identified(identified, path):
    content = model_file(
        identified,
        name="test",
        source="test log",
        records=["drive"],
        date=datetime.date(2026, 1, 2),
        train_fit_percent=np.array([91.234, 85.0]),
        validation_fit_percent=np.array([90.0, 84.0]),
    )
    write_model_file(path, content)
    return path


@pytest.mark.parametrize("structure", IDENTIFY)
def test_loaded_model_equals_the_identified_model(structure, tmp_path):
    identified = IDENTIFY[structure]()
    path = write_identified(identified, tmp_path / "model.yaml")
    loaded = load_model(path)
    for name in ("A", "B", "C", "dead_time"):
        assert getattr(loaded, name).tolist() == getattr(identified.model, name).tolist()
    assert loaded.structure == structure
    assert loaded.provenance["date"] == "2026-01-02"
    assert "omega of the gyro" in loaded.provenance["method"]
    data = read_model_file(path)
    assert data.fit_percent.v == 91.23
    assert data.validation_fit_percent.omega == 84.0
    uncertainty = data.uncertainty
    assert uncertainty.parameters == list(identified.parameters.names)
    deviation = np.array(uncertainty.standard_deviation)
    covariance = np.outer(deviation, deviation) * uncertainty.correlation
    scale = np.outer(identified.parameters.standard_deviation, identified.parameters.standard_deviation)
    assert np.abs(covariance - identified.parameters.covariance).max() < 1e-3 * scale.max()
    assert data.warnings == [str(doubt) for doubt in identified.warnings]


def steps(level):
    return np.concatenate([np.zeros(20), np.full(90, level), np.zeros(60)])


def experiment(command, output):
    return SampledExperiment("one", DT, command[:, None], output[:, None], np.ones((len(output), 1), dtype=bool))


def step_record(transfer, dead_time, level, noise=0.0, seed=0):
    command = steps(level)
    model = two_channels(transfer, transfer, (dead_time, dead_time))
    clean = model.discretise(DT).simulate(np.column_stack([command, command]))[:, 0]
    return experiment(command, clean + noise * np.random.default_rng(seed).normal(size=len(clean)))


def identify(experiments, **uncertainty):
    return identify_channel(experiments, "v", limit=False, robust=False, **uncertainty)


@pytest.mark.parametrize(
    ("gain", "frequency", "damping", "dead_time"),
    [(1.0, 10.0, 1.3, 0.04), (0.6, 25.0, 0.7, 0.013), (1.07, 14.0, 1.0, 0.0), (2.0, 6.0, 0.9, 0.11)],
)
def test_true_parameters_are_recovered_without_noise(gain, frequency, damping, dead_time):
    experiments = [step_record((gain, frequency, damping), dead_time, level) for level in (0.5, -0.8)]
    identified = identify(experiments)
    simulated = [simulate_experiment(identified.fit.system, experiment)[:, 0] for experiment in experiments]
    assert pooled_fit_percent([experiment.outputs[:, 0] for experiment in experiments], simulated) > 99.9
    assert identified.parameters.value("gain") == pytest.approx(gain, rel=1e-3)
    assert identified.parameters.value("natural_frequency") == pytest.approx(frequency, rel=2e-2)
    assert identified.parameters.value("damping") == pytest.approx(damping, rel=2e-2)
    assert identified.parameters.value("dead_time") == pytest.approx(dead_time, abs=1e-3)


def test_known_dead_time_is_not_estimated():
    identified = identify([step_record((1.0, 12.0, 1.1), 0.04, 0.5)], dead_time=0.04)
    assert identified.fit.system.dead_time.tolist() == [0.04]
    assert identified.parameters.names == ("gain", "natural_frequency", "damping")
    assert identified.parameters.values == pytest.approx([1.0, 12.0, 1.1], rel=1e-3)


def test_bound_on_the_shorter_time_constant_is_respected():
    """A robot with one lag has no second pole: without the bound its estimate would become arbitrarily fast."""
    one_lag = [step_record((1.0, 80.0, 4.5), 0.04, level) for level in (0.5, -0.8)]
    parameters = identify(one_lag, form=TwoPolesForm(min_short=5e-3)).parameters
    frequency, damping = parameters.value("natural_frequency"), parameters.value("damping")
    assert 0.5 / (frequency * damping) == pytest.approx(5e-3, rel=1e-3)
    assert parameters.value("dead_time") + 2 * damping / frequency == pytest.approx(0.04 + 0.1125, abs=2e-3)


def test_tracks_are_recovered():
    wheels = WheelKinematics(0.0675, 0.33).wheel_speeds([[0.5, 0.4], [0.2, -1.0], [0.0, 0.7]])
    difference = side_difference(wheels, 0.0675)
    yaw_rate = np.array([0.4, -1.0, 0.7]) * 0.6
    assert identify_track(difference, yaw_rate) == pytest.approx(0.33 / 0.6)
    with pytest.raises(ValueError, match="sign"):
        identify_track(difference, -yaw_rate)


def test_fit_is_100_percent_for_the_data_and_0_percent_for_their_mean():
    y = np.sin(np.arange(50.0))
    assert fit_percent(y, y) == 100.0
    assert fit_percent(y, np.full(50, y.mean())) == pytest.approx(0.0, abs=1e-9)
    assert fit_percent(y, -y) < 0
    with pytest.raises(ValueError, match="constant"):
        fit_percent(np.ones(5), np.ones(5))


def test_useless_data_are_refused():
    with pytest.raises(ValueError, match="not finite"):
        experiment(steps(1.0), np.full(170, np.nan))
    with pytest.raises(ValueError, match="never changes"):
        identify([experiment(np.ones(50), np.ones(50))])
    with pytest.raises(ValueError, match="sensor"):
        identify([experiment(steps(1.0), np.zeros(170))])
    with pytest.raises(ValueError, match="no data"):
        identify([])
