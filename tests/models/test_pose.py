"""Poses: arcs, angles, and calibration of the pose point."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identification_parts import DT, differences, set_points
from scipy.integrate import solve_ivp

from diffdrive_mpc import integrate_pose
from diffdrive_mpc.models.identification.fit.pose_calibration import (
    ConstantTrack,
    calibrate_gyro,
    calibrate_lags,
    calibrate_wheels,
)
from diffdrive_mpc.models.identification.fit.poses import rotation_centre
from diffdrive_mpc.models.identification.fit.slip import lateral_slip, slip_prior
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.pose import arc_displacement, wrap_angle
from diffdrive_mpc.models.slip_laws import virtual_track_yaw_rate
from oracle.motion import linearised_arc

poses = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-10, 10)).map(np.array)
speeds, times = st.floats(-2, 2), st.floats(1e-3, 0.5)
# Near the switch to the series and near zero, where an inexact formula fails.
slips = st.floats(-0.2, 0.2)
rates = st.one_of(st.floats(-3, 3), st.floats(-1e-6, 1e-6), st.floats(0.03, 0.05), st.just(0.0))


@given(poses, speeds, rates, times, slips)
def test_integrate_pose_matches_an_ode_solver(pose, v, omega, dt, slip):
    def motion(_, p):
        c, s, sideways = np.cos(p[2]), np.sin(p[2]), -slip * v * omega
        return [v * c - sideways * s, v * s + sideways * c, omega]

    expected = solve_ivp(motion, (0, dt), pose, rtol=1e-11, atol=1e-12).y[:, -1]
    assert integrate_pose(pose, v, omega, dt, slip) == pytest.approx(expected, abs=1e-9)


def arc_function():
    """Build the CasADi function of one arc."""
    pose, v, omega, dt = ca.SX.sym("pose", 3), ca.SX.sym("v"), ca.SX.sym("omega"), ca.SX.sym("dt")
    side_slip = ca.SX.sym("side_slip")
    end_pose = pose + arc_displacement(pose[2], v, omega, dt, -side_slip * v * omega)
    return ca.Function("arc", [pose, v, omega, dt, side_slip], [end_pose])


@given(poses, speeds, rates, times, slips)
def test_casadi_arc_equals_numpy(pose, v, omega, dt, slip):
    assert np.array(arc_function()(pose, v, omega, dt, slip)).ravel() == pytest.approx(
        integrate_pose(pose, v, omega, dt, slip), abs=1e-12
    )


@given(poses, speeds, rates, times, slips)
def test_gradients_agree_with_finite_differences(pose, v, omega, dt, slip):
    end_pose, by_pose, by_twist = linearised_arc(pose, v, omega, dt, slip)
    assert end_pose == pytest.approx(integrate_pose(pose, v, omega, dt, slip), abs=1e-13)
    assert by_pose == pytest.approx(differences(lambda p: integrate_pose(p, v, omega, dt, slip), pose), abs=1e-7)
    twist = np.array([v, omega, slip])
    expected = differences(lambda q: integrate_pose(pose, q[0], q[1], dt, q[2]), twist)
    assert by_twist == pytest.approx(expected, abs=1e-7)


@given(poses, speeds, rates, times, slips)
def test_casadi_derivatives_agree(pose, v, omega, dt, slip):
    arc = arc_function()
    p, twist = ca.SX.sym("p", 3), ca.SX.sym("twist", 3)
    end_pose = arc(p, twist[0], twist[1], dt, twist[2])
    jacobian = ca.Function("j", [p, twist], [ca.jacobian(end_pose, ca.vertcat(p, twist))])
    computed = np.array(jacobian(pose, [v, omega, slip]))
    assert np.isfinite(computed).all()
    assert computed == pytest.approx(np.hstack(linearised_arc(pose, v, omega, dt, slip)[1:]), abs=1e-9)


@given(poses, speeds, rates, times, st.floats(0.05, 0.95), slips)
def test_arc_in_two_parts_equals_the_whole_arc(pose, v, omega, dt, fraction, slip):
    half_way = integrate_pose(pose, v, omega, fraction * dt, slip)
    assert integrate_pose(half_way, v, omega, (1 - fraction) * dt, slip) == pytest.approx(
        integrate_pose(pose, v, omega, dt, slip), abs=1e-12
    )


@given(poses, speeds, rates, times)
def test_reversed_motion_returns_to_the_start(pose, v, omega, dt):
    assert integrate_pose(integrate_pose(pose, v, omega, dt), v, omega, -dt) == pytest.approx(pose, abs=1e-12)


@given(st.floats(-100, 100))
def test_wrapped_angle_has_the_same_direction(angle):
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-12)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-12)


RADIUS, TRACK = 0.07, 0.4


def drive(law, coefficients, lever_arm=(0.0, 0.0), noise=(0.0, 0.0), lag=0, seed=0):
    """Simulate wheels, gyro and poses of a robot that obeys `law` for 80 s; poses are delayed by `lag` samples."""
    count = 4000
    wheels = 6.0 * set_points(seed, count, (1.0, 1.0), hold=70)
    twist = law.twist(np.asarray(coefficients), 0.5 * (wheels[1:] + wheels[:-1]))
    poses = np.zeros((count, 3))
    for k, (v, lateral, omega) in enumerate(twist):
        along = integrate_pose(poses[k], v, omega, DT)
        across = integrate_pose(poses[k] + [0, 0, np.pi / 2], lateral, omega, DT)
        poses[k + 1] = along + [*(across - poses[k])[:2], 0.0]
    stream = np.random.default_rng(seed + 50)
    ahead, left = lever_arm
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    measured = poses + np.column_stack([ahead * c - left * s, ahead * s + left * c, np.zeros(count)])
    measured = measured[np.maximum(np.arange(count) - lag, 0)]
    measured += stream.normal(size=measured.shape) * [noise[0], noise[0], noise[1]]
    true_rate = law.twist(np.asarray(coefficients), wheels)[:, 2]
    return Record("drive", 0.0, DT, wheels, yaw_rate=1.03 * true_rate + 0.02, pose=measured, wheels=wheels)


LAW, TRUTH = ConstantTrack(RADIUS, TRACK), [0.068, 0.71, 0.08]


def test_constant_track_is_recovered():
    expected = [*TRUTH, *(lever_arm := (0.146, -0.03))]
    exact = calibrate_wheels([drive(LAW, TRUTH, lever_arm)], LAW).parameters
    assert exact.values == pytest.approx(expected, abs=1e-6)
    noisy = calibrate_wheels([drive(LAW, TRUTH, lever_arm, noise=(0.005, 0.005))], LAW).parameters
    assert np.all(np.abs(noisy.values - expected) < 4 * noisy.standard_deviation)
    assert np.all(noisy.standard_deviation > 0)


@given(p1=st.floats(0.0, 0.3), difference=st.floats(-3, 3))
def test_virtual_track_solves_its_equation(p1, difference):
    """yaw rate times (p1 |yaw rate| + p0) is the difference of the wheel speeds at the rims."""
    rate = virtual_track_yaw_rate(difference, 0.5, p1)
    assert rate * (p1 * abs(rate) + 0.5) == pytest.approx(difference, abs=1e-9)


@given(p1=st.floats(-0.5, 0.5), left=st.floats(-3, 3), right=st.floats(-3, 3))
def test_yaw_rate_of_a_virtual_track_grows_with_the_difference_of_the_wheels(p1, left, right):
    """This includes shrinking tracks without a solution, which a search may try."""
    slow, fast = virtual_track_yaw_rate([min(left, right), max(left, right)], 0.5, p1)
    assert slow <= fast
    assert virtual_track_yaw_rate(-left, 0.5, p1) == -virtual_track_yaw_rate(left, 0.5, p1)


def test_gyro_scale_is_estimated_with_late_poses():
    record = drive(LAW, TRUTH, noise=(0.005, 0.005), lag=5)
    result = calibrate_gyro([record], pose_lag=5 * DT)
    assert abs(result.parameters.value("gyro_scale") - 1.03) < 4 * result.parameters.deviation("gyro_scale")
    assert abs(result.parameters.value("gyro_offset") - 0.02) < 4 * result.parameters.deviation("gyro_offset")
    assert result.rmse[0] < 0.5 * calibrate_gyro([record]).rmse[0]


def test_lags_and_scale_of_the_wheels_are_estimated_from_poses():
    """Wheel readings are 4 % too high and three samples late; poses are one sample late, so the gyro precedes them."""
    record = drive(LAW, TRUTH, noise=(0.005, 0.005), lag=1)
    measured_twist = 1.04 * LAW.twist(np.array(TRUTH), np.roll(record.wheels, 3, axis=0))[:, [0, 2]]
    estimate = calibrate_lags([replace(record, twist=measured_twist)])
    assert np.all(np.abs(estimate.values - [2 * DT, 1.04, -DT]) < 4 * estimate.standard_deviation)
    assert np.all(estimate.standard_deviation < [0.3 * DT, 0.006, 0.3 * DT])


@given(x=st.floats(-5, 5), theta=st.floats(-4, 4), ahead=st.floats(-1, 1), left=st.floats(-1, 1))
@settings(max_examples=30)
def test_rotation_centre_is_at_the_lever_arm_behind_the_pose_point(x, theta, ahead, left):
    c, s = np.cos(theta), np.sin(theta)
    point = np.array([x + ahead * c - left * s, 1.0 + ahead * s + left * c, theta])
    assert rotation_centre(point, (ahead, left)) == pytest.approx([x, 1.0, theta], abs=1e-12)


def test_missing_signals_and_short_logs_are_refused():
    record = drive(LAW, TRUTH)
    with pytest.raises(ValueError, match="windows with a pose"):
        calibrate_wheels([record.part(0, 200)], LAW)
    poses_only = Record("mute", 0.0, DT, record.command, pose=record.pose)
    with pytest.raises(ValueError, match="requires pose and wheels"):
        calibrate_wheels([poses_only], LAW)
    with pytest.raises(ValueError, match="requires pose and yaw_rate"):
        calibrate_gyro([poses_only])


SAMPLES = 3000


def slipping_record(side_slip, load_shift, noise, seed=0):
    """Simulate a minute of driving in which the lateral speed follows the two terms."""
    stream, times = np.random.default_rng(seed), DT * np.arange(SAMPLES)
    v = 0.5 + 0.4 * np.sin(0.9 * times)
    omega = np.sin(0.5 * times) + 0.5 * np.sin(1.7 * times)
    lateral = -side_slip * v * omega + load_shift * np.gradient(v, DT) * omega
    theta = np.concatenate([[0.0], np.cumsum(0.5 * (omega[1:] + omega[:-1])) * DT])
    rate = np.column_stack([v * np.cos(theta) - lateral * np.sin(theta), v * np.sin(theta) + lateral * np.cos(theta)])
    position = np.vstack([np.zeros(2), np.cumsum(0.5 * (rate[1:] + rate[:-1]), axis=0) * DT])
    pose = np.column_stack([position, theta]) + noise * stream.standard_normal((SAMPLES, 3))
    twist = np.column_stack([v, omega])
    return Record("drive", 0.0, DT, twist, twist=twist, yaw_rate=omega, pose=pose)


@settings(deadline=None, max_examples=20)
@given(side_slip=st.floats(-0.05, 0.15), load_shift=st.floats(-0.05, 0.1))
def test_lateral_slip_is_identified(side_slip, load_shift):
    estimate = lateral_slip([slipping_record(side_slip, load_shift, 0.0)])
    # Windows of a second contain turns of up to 1.5 rad, in which the lateral direction is not constant.
    assert estimate.values == pytest.approx([side_slip, load_shift], abs=3e-3)


def test_deviation_of_lateral_slip_covers_its_error():
    errors = []
    for seed in range(20):
        result = lateral_slip([slipping_record(0.08, 0.03, 0.005, seed)])
        errors.append((result.values - [0.08, 0.03]) / result.standard_deviation)
    ratio = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (ratio > 0.5).all(), ratio
    assert (ratio < 2.0).all(), ratio


@pytest.mark.parametrize(("gyro", "stride"), [(True, 1), (False, 1), (True, 10)])
def test_slip_prior_contains_the_true_slip_with_and_without_gyro_and_with_few_poses(gyro, stride):
    drive_record = slipping_record(0.15, 0.02, 0.005)
    yaw_rate, fresh = drive_record.yaw_rate if gyro else None, np.arange(SAMPLES) % stride == 0
    twist = drive_record.twist * [1.0, 1.2]  # wheels of a skid-steer robot turn faster than its body
    record = Record("drive", 0.0, DT, twist, twist=twist, yaw_rate=yaw_rate, pose=drive_record.pose, fresh_pose=fresh)
    prior = slip_prior([record])
    assert prior.is_regressed
    assert (np.abs(prior.estimate.values - [0.15, 0.02]) < 2 * prior.estimate.standard_deviation).all()


def test_slip_prior_is_wide_without_poses_with_noisy_poses_and_without_turns():
    drive_record, zeros = slipping_record(0.1, 0.0, 0.0), np.zeros((SAMPLES, 3))
    without_pose = Record("mute", 0.0, DT, drive_record.twist, twist=drive_record.twist, yaw_rate=drive_record.yaw_rate)
    standing = replace(drive_record, twist=zeros[:, :2], yaw_rate=zeros[:, 0], pose=zeros)
    assert lateral_slip([]) is lateral_slip([without_pose]) is lateral_slip([standing]) is None
    assert slip_prior([without_pose]).estimate.values.tolist() == [0.06, 0.05]
    noisy = replace(drive_record, pose=drive_record.pose + np.random.default_rng(1).normal(size=zeros.shape))
    assert not any(slip_prior([record]).is_regressed for record in (without_pose, standing, noisy))
