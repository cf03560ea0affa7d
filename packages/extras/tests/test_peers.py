"""Nav2's regulated pure pursuit against what its documents say: carrot, speeds, turns, goal; and in the loop."""

import math

import numpy as np
import pytest
from bench_parts import Arc, DisplacedUnicycle, check_return, check_square
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc import Measurement, Stamped, load_trajectory, make_plant
from diffdrive_mpc.bench.peers import make_peer
from diffdrive_mpc.bench.peers.tracking_peer import make_tracking_peer
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim import simulate
from diffdrive_mpc_extras.peers.kanayama_plain import KanayamaController, load_plain_gains
from diffdrive_mpc_extras.peers.mppi import MppiGains
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
    for place in (1.0, 2.0, 3.0, x):
        v = follower.decide(np.array([place, 0.0, 0.0]), STILL)
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
    for place in (1.0, 2.0, 3.0):
        follower.decide(np.array([place, 0.0, 0.0]), STILL)
    pose = np.array([3.8, 0.0, 0.0])
    v, omega = follower.decide(pose, np.array([0.0, 1.0]))
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


NAMES = ("mppi", "mppi+slip")
MODERATE = MppiGains(lead=0.05, position=400, across=400, heading=5, smoothness=0.02, v_noise=0.1, omega_noise=0.3)
"""Gains for a start beside the path, for which the tuned ones are too stiff."""


@pytest.mark.parametrize("name", NAMES)
def test_robot_returns_to_the_reference_from_beside_it(name: str) -> None:
    check_return(make_tracking_peer(name, MODERATE))


def test_peer_completes_the_square_with_turns_on_the_spot() -> None:
    check_square(make_peer("mppi+slip"))


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_gives_the_same_run(name: str) -> None:
    runs = [simulate(make_peer(name), make_plant("model:sm", seed=5), Arc(duration=1.0)) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].command, runs[1].command)


@settings(max_examples=25, deadline=None)
@given(x=st.floats(-0.2, 0.2), y=st.floats(-0.2, 0.2), theta=st.floats(-0.5, 0.5))
def test_it_converges_from_beside_the_reference(x: float, y: float, theta: float) -> None:
    run = simulate(KanayamaController(), DisplacedUnicycle([x, y, theta]), Arc())
    settled = (run.time > 6.0) & run.counted
    assert run.errors.position[settled].max() < 2e-3 + 0.02 * np.hypot(x, y)
    assert np.abs(run.errors.heading[settled]).max() < 0.02


def test_the_law_is_that_of_the_paper() -> None:
    """Robot on the x axis, reference ahead by 0.02, to the left by 0.01 and turned left by 0.1."""
    gains = load_plain_gains()
    arc = Arc(duration=100.0)
    controller = KanayamaController()
    controller.start(arc, 0.0)
    pose = arc.sample([50.0]).pose[0]
    heading = pose[2] - 0.1
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    position = pose[:2] - 0.02 * ahead - 0.01 * left
    measurement = Measurement(pose=Stamped(np.array([*position, heading]), 50.0))
    for k in range(50):  # until slew no longer binds
        command = controller.step(50.0 + 0.02 * k, measurement).command
    v = 0.5 * np.cos(0.1) + gains.along * 0.02
    omega = 0.3 + 0.5 * (gains.across * 0.01 + gains.heading * np.sin(0.1))
    assert command == pytest.approx([v, omega], abs=1e-9)


def test_commands_stay_inside_limits_and_slew() -> None:
    robot = load_robot()
    run = simulate(KanayamaController(), DisplacedUnicycle([-3.0, 2.0, 2.5]), Arc())
    assert np.abs(run.command[:, 0]).max() <= robot.limits.v
    assert np.abs(run.command[:, 1]).max() <= robot.limits.omega
    change = np.abs(np.diff(run.command, axis=0, prepend=np.zeros((1, 2)))) / run.sample_time
    assert change[:, 0].max() <= robot.command_slew.v * (1 + 1e-9)
    assert change[:, 1].max() <= robot.command_slew.omega * (1 + 1e-9)
    assert change[:, 0].max() == pytest.approx(robot.command_slew.v)


def test_a_late_pose_is_compared_with_the_reference_of_its_own_time() -> None:
    """On the reference at cruising speed there is nothing to correct, however late the pose."""
    arc = Arc()
    controller = KanayamaController()
    controller.start(arc, 0.0)
    for k in range(100):
        t = 0.0202 * k
        step = controller.step(t, Measurement(pose=Stamped(arc.sample([t - 0.06]).pose[0], t - 0.06)))
    assert step.command == pytest.approx([0.5, 0.3], abs=1e-9)


def test_without_a_usable_pose_the_last_error_is_kept() -> None:
    arc = Arc()
    controller = KanayamaController()
    controller.start(arc, 0.0)
    start = Measurement(pose=Stamped(np.array([-0.1, 0.0, 0.0]), 0.0))
    for k in range(60):
        before = controller.step(0.0202 * k, start)
    lost = controller.step(0.0202 * 60, Measurement(pose=Stamped(np.array([np.nan, 0.0, 0.0]), 1.2)))
    none = controller.step(0.0202 * 61, Measurement())
    assert lost.command == pytest.approx(before.command)
    assert none.command == pytest.approx(before.command)
    assert "not finite" in lost.message
    assert none.message == before.message == ""
