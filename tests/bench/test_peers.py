"""Control laws of the peers compared with known results, and their common parts: estimate, prediction, limits."""

from itertools import product

import numpy as np
import pytest
from bench_parts import Arc, DisplacedUnicycle, check_return, check_square
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from diffdrive_mpc import (
    Measurement,
    MissingPackageError,
    integrate_pose,
    load_config,
    load_model,
    load_trajectory,
    make_plant,
)
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import make_controller
from diffdrive_mpc.bench.peers import LAWS, make_peer
from diffdrive_mpc.bench.peers.estimator import DelayPredictor, PredictedMotion
from diffdrive_mpc.bench.peers.kanayama import KanayamaGains, kanayama_twist
from diffdrive_mpc.bench.peers.lqr import LqrLaw
from diffdrive_mpc.bench.peers.pursuit import PursuitGains, PursuitLaw
from diffdrive_mpc.bench.peers.tracking_peer import LawInput, RobotParameters, law_kind, load_gains, make_tracking_peer
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.plants.surface import load_surface

CONFIG, MODEL = load_config("sm"), load_model("sm")
ROBOT = RobotParameters(CONFIG.sample_time, MODEL.lag - MODEL.dead_time, CONFIG.limits)
PATHS = ("square", "s")
PURSUIT = PursuitGains(lead=0.09, look_ahead_time=0.4, min_look_ahead=0.1, along=3.0, turn=3.0, least_radius=0.0)


@pytest.mark.parametrize("ticks", [0, 2, 5])
def test_predictor_gives_the_future_pose_of_a_perfect_plant(ticks: int) -> None:
    """Model, states and slip are those of the plant, and commands stay constant: the pose equals the plant's."""
    dt = CONFIG.sample_time
    plant = make_plant("model:sm", surface="slippery", sensors="perfect")
    slip = load_surface("slippery").slip
    known_slip = Slip(longitudinal_gain=slip.longitudinal_gain, yaw_gain=slip.yaw_gain, side_slip=slip.side_slip)
    predictor, sampled = DelayPredictor(MODEL, dt, ticks * dt), MODEL.discretise(dt)
    state, past = np.zeros(4), np.zeros((sampled.memory, 2))
    for k in range(60):
        command = np.array([0.6 + 0.3 * np.sin(0.2 * k), np.cos(0.3 * k)])
        (recent,), (previous,) = sampled.effective_inputs(command[None], past)
        state = sampled.A @ state + sampled.B0 @ recent + sampled.B1 @ previous
        past = np.vstack([past[1:], command])
        predictor.record_command(command)
        plant.advance(command)
    expected = predictor.predict(plant.true_pose, state, known_slip)
    for _ in range(ticks):
        plant.advance(command)
    # The plant's body moves at the angle of its side slip, the model at its tangent.
    assert expected.pose == pytest.approx(plant.true_pose, abs=2e-5)
    assert expected.twist == pytest.approx(plant.true_twist[[0, 2]], abs=1e-9)


@given(x=st.floats(-0.3, 0.3), y=st.floats(-0.3, 0.3), turn=st.floats(-1.0, 1.0), v=st.floats(-1.0, 1.0))
def test_lyapunov_function_of_kanayama_decreases_for_an_ideal_robot(x: float, y: float, turn: float, v: float) -> None:
    """V = (x^2 + y^2) / 2 + (1 - cos turn) / across, for a robot that follows commands immediately; any sign of v.

    The paper proves it for v > 0; for v < 0, front and rear of the robot are exchanged.
    """
    gains, omega = KanayamaGains(along=4.0, across=16.0, heading=8.0, turn=2.0), 0.3
    u, w = kanayama_twist(gains, np.array([v, omega]), np.array([x, y, turn]))
    # Error kinematics in the robot's frame.
    dx, dy, dturn = w * y - u + v * np.cos(turn), -w * x + v * np.sin(turn), omega - w
    rate = x * dx + y * dy + np.sin(turn) * dturn / gains.across
    expected = -gains.along * x**2 - (abs(v) * gains.heading + gains.turn) * np.sin(turn) ** 2 / gains.across
    assert rate == pytest.approx(expected, abs=1e-12)
    assert rate <= 1e-12


@pytest.mark.parametrize("twist", [(0.5, 0.5), (1.2, -1.0), (-0.4, 0.3)])
def test_lqr_gains_at_constant_speed_solve_the_algebraic_riccati_equation(twist: tuple[float, float]) -> None:
    law = LqrLaw(load_gains("lqr"), ROBOT)
    law.start(Arc(*twist, duration=20.0))
    A, B = law._linearise(*twist)
    P = solve_discrete_are(A, B, law._Q, law._R)
    K = np.linalg.solve(law._R + B.T @ P @ B, B.T @ P @ A)
    np.testing.assert_allclose(law._K[0], K, rtol=1e-4, atol=1e-6)
    assert np.abs(np.linalg.eigvals(A - B @ law._K[0])).max() < 1.0


def test_lqr_linearises_the_motion_of_the_robot() -> None:
    """One sample of A is compared with the exact motion near an arc."""
    law, dt = LqrLaw(load_gains("lqr"), ROBOT), 1e-3
    law._dt = dt
    v, omega = 0.7, 0.4
    A, _ = law._linearise(v, omega)
    error = 1e-4 * np.array([1.0, -2.0, 3.0, 0.0, 2.0, -1.0])
    end_pose = integrate_pose(error[:3], v + error[4], omega + error[5], dt)
    reference = integrate_pose(np.zeros(3), v, omega, dt)
    gap, (c, s) = end_pose - reference, (np.cos(reference[2]), np.sin(reference[2]))
    expected = np.array([c * gap[0] + s * gap[1], c * gap[1] - s * gap[0], gap[2]])
    np.testing.assert_allclose((A @ error)[:3], expected, atol=3e-9)


@pytest.mark.parametrize("v", [0.6, -0.6])
@settings(max_examples=25)
@given(x=st.floats(-0.1, 0.1), y=st.floats(-0.1, 0.1), turn=st.floats(-0.5, 0.5))
def test_arc_of_pursuit_passes_through_the_look_ahead_point(v: float, x: float, y: float, turn: float) -> None:
    law, arc = PursuitLaw(PURSUIT, ROBOT), Arc(v=v, omega=0.5, duration=20.0)
    law.start(arc)
    pose = arc.sample([2.0]).pose[0]
    forward = np.array([v, 0.5])
    view = LawInput(2.0, PredictedMotion(pose + [x, y, turn], forward), pose, forward)
    speed, turn = law.decide(view)
    look_ahead_point = law.look_ahead_point(view)
    # The pose after a drive along the arc until the chord equals the distance to the point.
    if abs(turn) > 1e-6:
        radius = speed / turn
        angle = 2 * np.arcsin(np.hypot(*look_ahead_point) / (2 * abs(radius))) * np.sign(turn)
        end_point = np.array([radius * np.sin(angle), radius * (1 - np.cos(angle))])
        assert np.hypot(*(end_point - look_ahead_point)) < 1e-6 or look_ahead_point[0] * v < 0


# The tests of the laws use moderate gains: some tuned gains without slip are too high for a displaced start.
MODERATE_GAINS = {
    "pursuit": PURSUIT.model_dump() | {"look_ahead_time": 0.3, "least_radius": 0.3},
    "kanayama": {"lead": 0.09, "along": 4, "across": 25, "heading": 10, "turn": 2},
    "lqr": {"lead": 0.05, "along": 20, "across": 60, "heading": 5, "integral": 10, "omega": 0.1},
}


@pytest.mark.parametrize("name", LAWS)
def test_peer_returns_to_the_reference_from_a_displaced_start(name: str) -> None:
    values = MODERATE_GAINS.get(name.partition("+")[0])
    gains = law_kind(name).gains(**values) if values else None
    run = check_return(make_tracking_peer(name, gains) if gains else make_peer(name))
    robot = load_robot()
    assert (np.abs(run.command) <= [robot.limits.v, robot.limits.omega]).all()
    change = np.abs(np.diff(run.command, axis=0, prepend=np.zeros((1, 2)))) / run.sample_time
    assert (change <= np.array([robot.command_slew.v, robot.command_slew.omega]) * (1 + 1e-9)).all()


@pytest.mark.parametrize(("name", "trajectory"), [*product(LAWS, PATHS)])
def test_every_peer_completes_the_shipped_paths(name: str, trajectory: str) -> None:
    """The square contains turns on the spot."""
    check_square(make_peer(name), trajectory)


@pytest.mark.parametrize("name", ["pursuit", "kanayama", "lqr"])
def test_peer_drives_backwards(name: str) -> None:
    run = simulate(make_peer(name), make_plant("model:sm", surface="ideal"), Arc(v=-0.5, omega=0.4, duration=5.0))
    # The speed of the reference jumps at the start: the robot has to catch up.
    assert run.errors.position[run.counted & (run.time > 4.0)].max() < 0.03


def test_peer_without_poses_brakes_with_a_message() -> None:
    peer, plant, arc = make_peer("pursuit"), DisplacedUnicycle(), Arc()
    peer.start(arc, 0.0)
    assert peer.step(0.0, Measurement()).mode == "BRAKING"
    peer.start(arc, 0.0)
    for k in range(150):
        t = k * plant.sample_time
        step = peer.step(t, plant.measure() if t < 1.0 else Measurement())
        plant.advance(step.command)
        if t < 1.0 + CONFIG.failure.max_pose_age - 0.1:
            assert step.mode == ("BRAKING" if t < 0 else "TRACKING")
    assert (step.mode, step.message) == ("BRAKING", "no recent pose")
    assert step.command == pytest.approx([0.0, 0.0])


def test_lean_into_the_curve_compensates_side_slip() -> None:
    errors = []
    for name in ("pursuit", "pursuit+slip"):
        run = simulate(make_peer(name), make_plant("model:sm", surface="slippery"), load_trajectory("circle"))
        errors.append(run.metrics.lateral_rmse_m)
    assert errors[1] < 0.7 * errors[0]


def test_missing_peer_names_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffdrive_mpc.bench.controllers.PEERS", LAWS)
    with pytest.raises(MissingPackageError, match=r"peer 'rpp' is in the package diffdrive-mpc-extras: pip install"):
        make_controller(Case(controller="rpp", model="none"))
