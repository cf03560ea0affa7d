"""MPPI as a peer: its law, and drives with it."""

from __future__ import annotations

import numpy as np
import pytest
from bench_parts import Arc

from diffdrive_mpc import load_config, load_model, load_trajectory, make_plant
from diffdrive_mpc.bench.peers import make_peer
from diffdrive_mpc.bench.peers.estimator import PredictedMotion
from diffdrive_mpc.bench.peers.tracking_peer import Delayed, LawInput, load_gains, make_tracking_peer
from diffdrive_mpc.sim import simulate
from diffdrive_mpc_extras.peers.mppi import MppiGains, MppiLaw

CONFIG, MODEL = load_config("sm"), load_model("sm")
ROBOT = Delayed(CONFIG.sample_time, MODEL.lag - MODEL.dead_time, CONFIG.limits)
NAMES = ("mppi", "mppi+slip")
MODERATE = MppiGains(lead=0.05, position=400, across=400, heading=5, smoothness=0.02, v_noise=0.1, omega_noise=0.3)
"""Gains for a start beside the path, for which the tuned ones are too stiff."""


def test_more_samples_approach_the_command_that_keeps_the_reference() -> None:
    """On the reference, at its twist, there is nothing to correct: what MPPI adds is the noise of its sampling."""
    found = []
    for samples in (30, 3000):
        law, arc = MppiLaw(load_gains("mppi"), ROBOT, samples), Arc(duration=20.0)
        law.start(arc)
        here = arc.sample([2.0]).pose[0]
        found.append(
            np.abs(
                law.decide(LawInput(2.0, PredictedMotion(here, np.array([0.5, 0.3])), here, np.array([0.5, 0.3])))
                - [0.5, 0.3]
            ).max()
        )
    assert found[1] < 0.05
    assert found[1] < found[0]


@pytest.mark.parametrize("name", NAMES)
def test_robot_returns_to_the_reference_from_beside_it(name: str) -> None:
    plant = make_plant("model:sm", surface="ideal", sensors="perfect")
    plant.reset = lambda pose: type(plant).reset(plant, [-0.05, 0.1, 0.1])
    run = simulate(make_tracking_peer(name, MODERATE), plant, Arc(duration=6.0))
    late = run.counted & (run.time > 4.5)
    assert run.errors.position[0] > 0.1
    assert run.errors.position[late].max() < 0.02


def test_peer_completes_the_square_with_turns_on_the_spot() -> None:
    run = simulate(make_peer("mppi+slip"), make_plant("model:sm", seed=0), load_trajectory("square"))
    assert run.metrics.completed
    assert run.errors.position[run.counted].max() < 0.05
    assert set(run.modes[:-1]) <= {"TRACKING", "FINISHED"}


def test_peer_drives_backwards() -> None:
    run = simulate(make_peer("mppi"), make_plant("model:sm", surface="ideal"), Arc(v=-0.5, omega=0.4, duration=5.0))
    assert run.errors.position[run.counted & (run.time > 4.0)].max() < 0.03


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_gives_the_same_run(name: str) -> None:
    runs = [simulate(make_peer(name), make_plant("model:sm", seed=5), Arc(duration=1.0)) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].command, runs[1].command)
