"""Each effect around the linear dynamics obeys its physics."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from diffdrive_mpc.models.base_effects import PoseMount, TwistSlew, Veer, WheelCommand, YawRelaxation

TWISTS = arrays(float, (2,), elements=st.floats(-3, 3, allow_subnormal=False))
STEPS = WheelCommand(track=0.5, resolution=0.01, coasting_speed=0.08, top_speed=2.0)
LENGTHS = st.floats(-1, 1)


@given(TWISTS, TWISTS, st.floats(0.001, 0.5))
def test_slew_is_bounded_and_never_overshoots(start, command, dt):
    slew = TwistSlew(v=1.0, omega=3.0)
    reached = slew.step(start, command, dt)
    assert (np.abs(reached - start) <= np.array([1.0, 3.0]) * dt + 1e-12).all()
    assert (np.abs(command - reached) <= np.abs(command - start) + 1e-12).all()


def test_slew_takes_the_time_of_its_slope():
    """A step of omega by 1.5 rad/s at 3 rad/s^2 takes half a second, and v is not held back by it."""
    path = TwistSlew(v=1.0, omega=3.0).follow(np.tile([0.05, 1.5], (30, 1)), 0.02, (0.0, 0.0))
    np.testing.assert_allclose(path[:25, 1], 0.06 * np.arange(1, 26))
    assert (path[25:, 1] == 1.5).all()
    assert (path[2:, 0] == 0.05).all()


@given(TWISTS)
def test_sides_and_twist_are_inverse(twist):
    np.testing.assert_allclose(STEPS.twist(STEPS.sides(twist)), twist, atol=1e-12)


@given(TWISTS)
def test_what_the_motors_are_asked_for_is_whole_steps_not_beyond_the_command(twist):
    wanted, sides = STEPS.sides(twist), STEPS.sides(STEPS.apply(twist))
    steps = sides[~STEPS.coasts(twist)] / STEPS.resolution
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert (np.abs(sides) <= 2.0 + 1e-9).all()
    held = ~STEPS.coasts(twist)
    assert (np.abs(sides[held]) <= np.abs(wanted[held]) + 1e-9).all()
    near = held & (np.abs(wanted) < 2.0)
    assert (np.abs(wanted[near] - sides[near]) < STEPS.resolution + 1e-9).all()


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_a_side_never_runs_slower_for_a_greater_command(left, right, other):
    """Monotone in each side while the other is held: true without coasting, which depends on the other side."""
    firm = STEPS.model_copy(update={"coasting_speed": 0.0})
    low, high = sorted([left, right])
    slower, faster = (firm.sides(firm.apply(firm.twist(np.array([side, other]))))[0] for side in (low, high))
    assert faster >= slower - 1e-9


@pytest.mark.parametrize(("other", "rolls"), [(1.0, 0.08), (-1.0, -0.08), (0.05, 0.05)])
def test_a_side_without_a_step_rolls_along_with_the_other(other, rolls):
    asked = STEPS.apply(STEPS.twist(np.array([0.009, other])))
    np.testing.assert_allclose(STEPS.sides(asked), [rolls, other], atol=1e-9)


def test_a_robot_that_stands_does_not_coast():
    assert not STEPS.coasts([0.0, 0.0]).any()
    assert (STEPS.apply([0.004, 0.0]) == 0.0).all()


@given(TWISTS)
def test_slope_is_the_derivative_of_the_map_without_steps(twist):
    smooth = STEPS.model_copy(update={"resolution": 0.0})
    speeds = np.abs(smooth.sides(twist))
    assume(np.abs(speeds - 2.0).min() > 1e-3 and speeds.min() > 1e-3)
    h = 1e-5
    columns = [(smooth.apply(twist + h * unit) - smooth.apply(twist - h * unit)) / (2 * h) for unit in np.eye(2)]
    np.testing.assert_allclose(smooth.slope(twist), np.column_stack(columns), atol=1e-6)


def test_slope_of_a_coasting_side_follows_the_other():
    slow, fast = (STEPS.twist(np.array([0.0, right])) for right in (0.055, 1.0))
    np.testing.assert_allclose(STEPS.slope(slow), [[1.0, 0.25], [0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(STEPS.slope(fast), [[0.5, 0.125], [2.0, 0.5]], atol=1e-12)


@given(st.floats(-1, 1), st.floats(-3, 3), st.floats(0.001, 1.0), st.floats(0.005, 0.5))
def test_strain_stays_bounded_and_the_heading_adds_up(strain, rate, dt, angle):
    end, body = YawRelaxation(angle=angle).advance(strain, rate, dt)
    assert -1 <= end <= 1
    assert body * dt == pytest.approx(rate * dt - angle * (end - strain), abs=1e-12)
    assert abs(body) <= abs(rate) * (1 + 1e-9) + 1e-12


@given(st.floats(-1, 1), st.floats(-3, 3), st.floats(0.01, 1.0))
def test_two_half_samples_are_one(strain, rate, dt):
    relaxation = YawRelaxation(angle=0.04)
    once, mean = relaxation.advance(strain, rate, dt)
    middle, first = relaxation.advance(strain, rate, dt / 2)
    twice, second = relaxation.advance(middle, rate, dt / 2)
    assert twice == pytest.approx(once, abs=1e-12)
    assert 0.5 * (first + second) == pytest.approx(mean, abs=1e-9)


def test_a_reversal_costs_twice_the_angle_and_a_pause_nothing():
    relaxation = YawRelaxation(angle=0.035)
    dt = 0.01
    rates = np.concatenate([np.full(100, 0.8), np.zeros(50), np.full(100, 0.8), np.full(200, -0.8)])
    body = relaxation.follow(rates, dt, 1.0)
    np.testing.assert_allclose(body[:250], rates[:250], atol=1e-12)
    lost = dt * np.sum(body[250:] - rates[250:])
    assert lost == pytest.approx(2 * 0.035, rel=0.12)
    assert relaxation.gain(1.0, 0.8) == 1.0
    assert relaxation.gain(1.0, -0.8) == -1.0


@given(TWISTS, LENGTHS)
def test_veer_inverts(twist, yaw_per_metre):
    veer = Veer(yaw_per_metre=yaw_per_metre)
    np.testing.assert_allclose(veer.wheels(veer.body(twist)), twist, atol=1e-12)
    assert veer.body([2.0, 0.0])[1] == pytest.approx(2 * yaw_per_metre)


@given(arrays(float, (3,), elements=st.floats(-4, 4)), LENGTHS, LENGTHS, LENGTHS)
def test_pose_mount_inverts_and_is_rigid(pose, ahead, left, heading):
    mount = PoseMount(ahead=ahead, left=left, heading=heading)
    centre = mount.centre(pose)
    np.testing.assert_allclose(mount.sensor(centre), pose, atol=1e-12)
    assert np.hypot(*(centre - pose)[:2]) == pytest.approx(np.hypot(ahead, left), abs=1e-12)


def test_a_sensor_ahead_of_the_centre_draws_a_circle_when_the_robot_turns_on_the_spot():
    mount = PoseMount(ahead=0.15, left=0.04, heading=0.1)
    turning = np.column_stack([np.full(7, 2.0), np.full(7, -1.0), np.linspace(0.0, 6.0, 7)])
    seen = mount.sensor(turning)
    np.testing.assert_allclose(np.hypot(seen[:, 0] - 2.0, seen[:, 1] + 1.0), np.hypot(0.15, 0.04))
    np.testing.assert_allclose(
        seen[0], [2 + 0.15 * np.cos(0.1) + 0.04 * np.sin(0.1), -1 + 0.04 * np.cos(0.1) - 0.15 * np.sin(0.1), -0.1]
    )
