"""Peers: regulated pure pursuit compared with Nav2's documentation, MPPI, and the law of Kanayama et al."""

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

DEFAULTS = load_parameters()
AT_REST = np.zeros(2)


def make_law(path, **changes):
    return PurePursuit(np.asarray(path, dtype=float), DEFAULTS.model_copy(update=changes), 0.05)


def straight(length=4.0, heading=0.0):
    x = np.arange(0.0, length + 0.01, 0.05)
    return np.column_stack([x, 0.0 * x, 0.0 * x + heading])


def arc(radius, length=4.0):
    angle = np.arange(0.0, length / radius, 0.02 / radius)
    return np.column_stack([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle])


def test_pursuit_drives_a_straight_path_at_the_desired_speed():
    np.testing.assert_allclose(
        make_law(straight()).decide(np.zeros(3), AT_REST), [DEFAULTS.desired_linear_vel, 0.0], atol=1e-12
    )


@given(lateral=st.floats(-0.4, 0.4))
def test_pursuit_drives_an_arc_through_the_carrot(lateral):
    """The curvature of pure pursuit is 2 y / L^2 for a carrot at the lateral offset y and the distance L."""
    v, omega = make_law(straight()).decide(np.array([0.0, lateral, 0.0]), AT_REST)
    assert omega / v == pytest.approx(-2.0 * lateral / DEFAULTS.lookahead_dist**2, abs=1e-9)


@given(radius=st.floats(0.45, 3.0))
def test_pursuit_scales_the_speed_with_the_radius_down_to_the_minimum(radius):
    v, omega = make_law(arc(radius)).decide(np.zeros(3), AT_REST)
    # The robot is on the arc, so pure pursuit follows the arc.
    assert omega / v == pytest.approx(1.0 / radius, rel=2e-3)
    expected = DEFAULTS.desired_linear_vel * min(1.0, radius / DEFAULTS.regulated_linear_scaling_min_radius)
    assert v == pytest.approx(max(expected, DEFAULTS.regulated_linear_scaling_min_speed), rel=2e-3)


@given(distance=st.floats(0.26, 0.55))
def test_pursuit_scales_the_speed_with_the_distance_during_the_approach(distance):
    follower = make_law(straight())
    for x in (1.0, 2.0, 3.0, 4.0 - distance):
        v = follower.decide(np.array([x, 0.0, 0.0]), AT_REST)
    assert v[0] == pytest.approx(DEFAULTS.desired_linear_vel * distance / DEFAULTS.approach_velocity_scaling_dist)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_pursuit_rotates_in_place_towards_a_carrot_at_a_large_angle(side):
    follower = make_law(straight())
    v, omega = follower.decide(np.array([0.0, 0.0, -side * 1.2]), AT_REST)
    assert v == 0.0
    assert omega == pytest.approx(side * DEFAULTS.max_angular_accel * 0.05)
    v, omega = follower.decide(np.array([0.0, 0.0, -side * 1.2]), np.array([0.0, side * 1.8]))
    assert omega == pytest.approx(side * DEFAULTS.rotate_to_heading_angular_vel)
    assert follower.decide(np.array([0.0, 0.0, -side * 0.7]), AT_REST)[0] > 0.0


def test_pursuit_rotates_to_the_heading_of_the_goal_and_ends():
    path = straight(heading=0.0)
    path[-1, 2] = 1.0
    follower = make_law(path)
    for x in (1.0, 2.0, 3.0):
        follower.decide(np.array([x, 0.0, 0.0]), AT_REST)
    pose = np.array([3.8, 0.0, 0.0])
    v, omega = follower.decide(pose, np.array([0.0, 1.0]))
    assert v == 0.0
    assert omega > 0.0
    # The yaw rate decreases with the remaining angle, so that the robot can stop in time.
    v, omega = follower.decide(np.array([3.8, 0.0, 0.7]), np.array([0.0, 1.8]))
    assert omega <= math.sqrt(2.0 * DEFAULTS.max_angular_accel * 0.3) + 1e-12
    assert follower.decide(np.array([3.8, 0.0, 0.8]), AT_REST) is None


@pytest.mark.parametrize("name", ["circle", "cane"])
def test_pursuit_reaches_the_goal_in_closed_loop(name):
    reference = load_trajectory(name)
    plant = make_plant("model:ssm+0.005", surface="ideal", sensors="perfect")
    run = simulate(make_peer("rpp"), plant, reference, extra_time=10.0)
    assert run.modes[-1] == "FINISHED"
    goal = path_of(reference, DEFAULTS.path_spacing)[-1]
    assert math.hypot(*(run.true_pose[-1] - goal)[:2]) <= DEFAULTS.xy_goal_tolerance + 0.02
    assert np.abs(run.command[:, 0]).max() <= DEFAULTS.desired_linear_vel + 1e-9


NAMES = ("mppi", "mppi+slip")
SOFT_GAINS = MppiGains(lead=0.05, position=400, across=400, heading=5, smoothness=0.02, v_noise=0.1, omega_noise=0.3)
"""Gains for a start with a large error, for which the tuned gains are too high."""


@pytest.mark.parametrize("name", NAMES)
def test_mppi_returns_to_the_reference_from_a_displaced_start(name: str) -> None:
    check_return(make_tracking_peer(name, SOFT_GAINS))


def test_peer_completes_the_square_with_turns_on_the_spot() -> None:
    check_square(make_peer("mppi+slip"))


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_gives_the_same_run(name: str) -> None:
    runs = [simulate(make_peer(name), make_plant("model:sm", seed=5), Arc(duration=1.0)) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].command, runs[1].command)


@settings(max_examples=25, deadline=None)
@given(x=st.floats(-0.2, 0.2), y=st.floats(-0.2, 0.2), theta=st.floats(-0.5, 0.5))
def test_kanayama_controller_converges_from_a_displaced_start(x: float, y: float, theta: float) -> None:
    run = simulate(KanayamaController(), DisplacedUnicycle([x, y, theta]), Arc())
    is_settled = (run.time > 6.0) & run.counted
    assert run.errors.position[is_settled].max() < 2e-3 + 0.02 * np.hypot(x, y)
    assert np.abs(run.errors.heading[is_settled]).max() < 0.02


def test_kanayama_controller_agrees_with_the_law_of_the_paper() -> None:
    """The reference is 0.02 m ahead, 0.01 m to the left, and turned left by 0.1 rad."""
    gains = load_plain_gains()
    arc = Arc(duration=100.0)
    controller = KanayamaController()
    controller.start(arc, 0.0)
    pose = arc.sample([50.0]).pose[0]
    heading = pose[2] - 0.1
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    position = pose[:2] - 0.02 * ahead - 0.01 * left
    measurement = Measurement(pose=Stamped(np.array([*position, heading]), 50.0))
    for k in range(50):  # until the slew limits are inactive
        command = controller.step(50.0 + 0.02 * k, measurement).command
    v = 0.5 * np.cos(0.1) + gains.along * 0.02
    omega = 0.3 + 0.5 * (gains.across * 0.01 + gains.heading * np.sin(0.1))
    assert command == pytest.approx([v, omega], abs=1e-9)


def test_commands_satisfy_limits_and_slew() -> None:
    robot = load_robot()
    run = simulate(KanayamaController(), DisplacedUnicycle([-3.0, 2.0, 2.5]), Arc())
    assert np.abs(run.command[:, 0]).max() <= robot.limits.v
    assert np.abs(run.command[:, 1]).max() <= robot.limits.omega
    change = np.abs(np.diff(run.command, axis=0, prepend=np.zeros((1, 2)))) / run.sample_time
    assert change[:, 0].max() <= robot.command_slew.v * (1 + 1e-9)
    assert change[:, 1].max() <= robot.command_slew.omega * (1 + 1e-9)
    assert change[:, 0].max() == pytest.approx(robot.command_slew.v)


def test_delayed_pose_is_compared_with_the_reference_at_its_stamp() -> None:
    """A robot on the reference at constant speed has no error, independent of the delay of the pose."""
    arc = Arc()
    controller = KanayamaController()
    controller.start(arc, 0.0)
    for k in range(100):
        t = 0.0202 * k
        step = controller.step(t, Measurement(pose=Stamped(arc.sample([t - 0.06]).pose[0], t - 0.06)))
    assert step.command == pytest.approx([0.5, 0.3], abs=1e-9)


def test_missing_or_nan_pose_does_not_change_the_error() -> None:
    arc = Arc()
    controller = KanayamaController()
    controller.start(arc, 0.0)
    start = Measurement(pose=Stamped(np.array([-0.1, 0.0, 0.0]), 0.0))
    for k in range(60):
        valid_step = controller.step(0.0202 * k, start)
    nan_step = controller.step(0.0202 * 60, Measurement(pose=Stamped(np.array([np.nan, 0.0, 0.0]), 1.2)))
    empty_step = controller.step(0.0202 * 61, Measurement())
    assert nan_step.command == pytest.approx(valid_step.command)
    assert empty_step.command == pytest.approx(valid_step.command)
    assert "not finite" in nan_step.message
    assert empty_step.message == valid_step.message == ""
