"""The exact arc: against an ODE solver, its gradient against finite differences, smooth through omega = 0."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from diffdrive_mpc.models import integrate_pose
from diffdrive_mpc.models.pose import arc_displacement, wrap_angle
from oracle.arc import linearised_arc

poses = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-10, 10)).map(np.array)
speeds, times = st.floats(-2, 2), st.floats(1e-3, 0.5)
# Around the switch to the series and around zero, where a sloppy formula shows.
slips = st.floats(-0.2, 0.2)
rates = st.one_of(st.floats(-3, 3), st.floats(-1e-6, 1e-6), st.floats(0.03, 0.05), st.just(0.0))


@given(poses, speeds, rates, times, slips)
def test_matches_an_ode_solver(pose, v, omega, dt, slip):
    def motion(_, p):
        c, s, sideways = np.cos(p[2]), np.sin(p[2]), -slip * v * omega
        return [v * c - sideways * s, v * s + sideways * c, omega]

    expected = solve_ivp(motion, (0, dt), pose, rtol=1e-11, atol=1e-12).y[:, -1]
    assert integrate_pose(pose, v, omega, dt, slip) == pytest.approx(expected, abs=1e-9)


def arc_function():
    """CasADi function of one arc."""
    pose, v, omega, dt = ca.SX.sym("pose", 3), ca.SX.sym("v"), ca.SX.sym("omega"), ca.SX.sym("dt")
    side_slip = ca.SX.sym("side_slip")
    after = pose + arc_displacement(pose[2], v, omega, dt, -side_slip * v * omega)
    return ca.Function("arc", [pose, v, omega, dt, side_slip], [after])


@given(poses, speeds, rates, times, slips)
def test_casadi_agrees_with_numpy(pose, v, omega, dt, slip):
    assert np.array(arc_function()(pose, v, omega, dt, slip)).ravel() == pytest.approx(
        integrate_pose(pose, v, omega, dt, slip), abs=1e-12
    )


@given(poses, speeds, rates, times, slips)
def test_gradients_agree_with_finite_differences(pose, v, omega, dt, slip):
    after, by_pose, by_twist = linearised_arc(pose, v, omega, dt, slip)
    assert after == pytest.approx(integrate_pose(pose, v, omega, dt, slip), abs=1e-13)
    step = 1e-6

    def differences(function, at):
        columns = [(function(at + step * e) - function(at - step * e)) / (2 * step) for e in np.eye(len(at))]
        return np.column_stack(columns)

    assert by_pose == pytest.approx(differences(lambda p: integrate_pose(p, v, omega, dt, slip), pose), abs=1e-7)
    twist = np.array([v, omega, slip])
    expected = differences(lambda q: integrate_pose(pose, q[0], q[1], dt, q[2]), twist)
    assert by_twist == pytest.approx(expected, abs=1e-7)


@given(poses, speeds, rates, times, slips)
def test_casadi_derivatives_agree(pose, v, omega, dt, slip):
    arc = arc_function()
    p, twist = ca.SX.sym("p", 3), ca.SX.sym("twist", 3)
    after = arc(p, twist[0], twist[1], dt, twist[2])
    jacobian = ca.Function("j", [p, twist], [ca.jacobian(after, ca.vertcat(p, twist))])
    computed = np.array(jacobian(pose, [v, omega, slip]))
    assert np.isfinite(computed).all()
    assert computed == pytest.approx(np.hstack(linearised_arc(pose, v, omega, dt, slip)[1:]), abs=1e-9)


@given(poses, speeds, rates, times, st.floats(0.05, 0.95), slips)
def test_an_arc_in_two_parts_is_the_same_arc(pose, v, omega, dt, share, slip):
    half_way = integrate_pose(pose, v, omega, share * dt, slip)
    assert integrate_pose(half_way, v, omega, (1 - share) * dt, slip) == pytest.approx(
        integrate_pose(pose, v, omega, dt, slip), abs=1e-12
    )


@given(poses, speeds, rates, times)
def test_going_back_returns(pose, v, omega, dt):
    assert integrate_pose(integrate_pose(pose, v, omega, dt), v, omega, -dt) == pytest.approx(pose, abs=1e-12)


def test_arrays_broadcast():
    moved = integrate_pose(np.zeros(3), np.linspace(0, 1, 4), 0.0, 2.0)
    assert moved == pytest.approx(np.column_stack([2 * np.linspace(0, 1, 4), np.zeros(4), np.zeros(4)]))
    assert integrate_pose(np.zeros((5, 3)), 1.0, np.ones(5), 0.1).shape == (5, 3)


def test_a_left_turn_goes_left():
    assert integrate_pose([0, 0, 0], 1.0, np.pi / 2, 1.0) == pytest.approx([2 / np.pi, 2 / np.pi, np.pi / 2])


@given(st.floats(-100, 100))
def test_wrapped_angles_point_the_same_way(angle):
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-12)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-12)
