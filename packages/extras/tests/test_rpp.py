"""Nav2's regulated pure pursuit against what its documents say: carrot, speeds, turns, goal; and in the loop."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.bench.peers import make_peer
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc_extras.peers.rpp import PurePursuit, load_parameters, path_of

P = load_parameters()
STILL = np.zeros(2)


def law(path, **changes):
    return PurePursuit(np.asarray(path, dtype=float), P.model_copy(update=changes), 0.05)


def straight(length=4.0, heading=0.0):
    x = np.arange(0.0, length + 0.01, 0.05)
    return np.column_stack([x, 0.0 * x, 0.0 * x + heading])


def arc(radius, length=4.0):
    angle = np.arange(0.0, length / radius, 0.02 / radius)
    return np.column_stack([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle])


def test_on_a_straight_path_it_drives_straight_at_the_desired_speed():
    np.testing.assert_allclose(law(straight()).decide(np.zeros(3), STILL), [P.desired_linear_vel, 0.0], atol=1e-12)


@given(aside=st.floats(-0.4, 0.4))
def test_beside_it_the_arc_goes_through_the_carrot(aside):
    """On the circle of the look-ahead about the robot: its curvature is 2 y / L^2, the law of pure pursuit."""
    v, omega = law(straight()).decide(np.array([0.0, aside, 0.0]), STILL)
    assert omega / v == pytest.approx(-2.0 * aside / P.lookahead_dist**2, abs=1e-9)


@given(radius=st.floats(0.45, 3.0))
def test_it_slows_down_in_proportion_to_the_radius_but_not_below_its_least(radius):
    v, omega = law(arc(radius)).decide(np.zeros(3), STILL)
    # On the arc itself: a chord leads back onto it.
    assert omega / v == pytest.approx(1.0 / radius, rel=2e-3)
    expected = P.desired_linear_vel * min(1.0, radius / P.regulated_linear_scaling_min_radius)
    assert v == pytest.approx(max(expected, P.regulated_linear_scaling_min_speed), rel=2e-3)


@given(left=st.floats(0.26, 0.55))
def test_on_approach_it_slows_down_with_the_distance(left):
    x = 4.0 - left
    follower = law(straight())
    for at in (1.0, 2.0, 3.0, x):
        v = follower.decide(np.array([at, 0.0, 0.0]), STILL)
    assert v[0] == pytest.approx(P.desired_linear_vel * left / P.approach_velocity_scaling_dist)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_it_turns_on_the_spot_to_a_carrot_far_aside_as_fast_as_it_can_stop(side):
    follower = law(straight())
    v, omega = follower.decide(np.array([0.0, 0.0, -side * 1.2]), STILL)
    assert v == 0.0
    assert omega == pytest.approx(side * P.max_angular_accel * 0.05)
    v, omega = follower.decide(np.array([0.0, 0.0, -side * 1.2]), np.array([0.0, side * 1.8]))
    assert omega == pytest.approx(side * P.rotate_to_heading_angular_vel)
    assert follower.decide(np.array([0.0, 0.0, -side * 0.7]), STILL)[0] > 0.0


def test_at_the_goal_it_turns_to_its_heading_and_ends():
    path = straight(heading=0.0)
    path[-1, 2] = 1.0
    follower = law(path)
    for at in (1.0, 2.0, 3.0):
        follower.decide(np.array([at, 0.0, 0.0]), STILL)
    here = np.array([3.8, 0.0, 0.0])
    v, omega = follower.decide(here, np.array([0.0, 1.0]))
    assert v == 0.0
    assert omega > 0.0
    # Slower, the less there is to turn, so that it can be stopped from.
    v, omega = follower.decide(np.array([3.8, 0.0, 0.7]), np.array([0.0, 1.8]))
    assert omega <= math.sqrt(2.0 * P.max_angular_accel * 0.3) + 1e-12
    assert follower.decide(np.array([3.8, 0.0, 0.8]), STILL) is None


@pytest.mark.parametrize("name", ["circle", "cane"])
def test_in_the_loop_it_comes_to_its_goal_within_its_tolerance(name):
    reference = load_trajectory(name)
    plant = make_plant("model:ssm+0.005", surface="ideal", sensors="perfect")
    run = simulate(make_peer("rpp"), plant, reference, extra_time=10.0)
    assert run.modes[-1] == "FINISHED"
    goal = path_of(reference, P.path_spacing)[-1]
    assert math.hypot(*(run.true_pose[-1] - goal)[:2]) <= P.xy_goal_tolerance + 0.02
    assert np.abs(run.command[:, 0]).max() <= P.desired_linear_vel + 1e-9


def test_before_start_there_is_nothing_to_follow():
    plant = make_plant("model:ssm", surface="ideal", sensors="perfect")
    with pytest.raises(RuntimeError, match="call start"):
        make_peer("rpp").step(0.0, plant.measure())
