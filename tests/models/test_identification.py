"""Output-error identification finds known truths, and refuses records it cannot learn from."""

import numpy as np
import pytest

from diffdrive_mpc.models import VelocityModel
from diffdrive_mpc.models.identification import (
    Experiment,
    fit_percent,
    identify_track,
    identify_two_poles,
    side_difference,
    simulate_two_poles,
)
from diffdrive_mpc.models.structures import SmFile, TwoPoles
from diffdrive_mpc.models.wheels import WheelKinematics

DT = 0.0202


def steps(level):
    return np.concatenate([np.zeros(20), np.full(90, level), np.zeros(60)])


def record(transfer, dead_time, level, noise=0.0, seed=0):
    command = steps(level)
    clean = simulate_two_poles(transfer, dead_time, Experiment("truth", DT, command, command))
    noisy = clean + noise * np.random.default_rng(seed).normal(size=len(clean))
    return Experiment(f"step to {level}", DT, command, noisy)


@pytest.mark.parametrize(
    ("gain", "frequency", "damping", "dead_time"),
    [(1.0, 10.0, 1.3, 0.04), (0.6, 25.0, 0.7, 0.013), (1.07, 14.0, 1.0, 0.0), (2.0, 6.0, 0.9, 0.11)],
)
def test_known_truth_is_recovered_without_noise(gain, frequency, damping, dead_time):
    truth = TwoPoles(gain=gain, natural_frequency=frequency, damping=damping)
    fit = identify_two_poles([record(truth, dead_time, level) for level in (0.5, -0.8)])
    assert fit.fit_percent > 99.9
    assert fit.transfer.gain == pytest.approx(gain, rel=1e-3)
    assert fit.transfer.natural_frequency == pytest.approx(frequency, rel=2e-2)
    assert fit.transfer.damping == pytest.approx(damping, rel=2e-2)
    assert fit.dead_time == pytest.approx(dead_time, abs=1e-3)


def test_the_simulation_is_that_of_the_velocity_model():
    transfer = TwoPoles(gain=0.9, natural_frequency=15.0, damping=0.8)
    data = SmFile(
        name="both",
        structure="sm",
        provenance={"origin": "identified", "source": "test"},
        channels={"v": transfer, "omega": transfer},
    )
    A, B, C = data.matrices()
    model = VelocityModel("both", "sm", A, B, C, np.array([0.047, 0.047])).discretise(DT)
    command = 0.3 + steps(0.5)
    start = np.full(2, command[0])
    both = model.simulate(
        np.column_stack([command, command]), model.settled_state(start), np.tile(start, (model.memory, 1))
    )
    simulated = simulate_two_poles(transfer, 0.047, Experiment("one", DT, command, command))
    assert both == pytest.approx(np.column_stack([simulated, simulated]), abs=1e-9)


def test_noise_moves_the_lag_little():
    truth = TwoPoles(gain=1.0, natural_frequency=12.0, damping=1.1)
    logs = [record(truth, 0.04, level, noise=0.01, seed=i) for i, level in enumerate((0.5, -0.5, 0.75, -0.75))]
    fit = identify_two_poles(logs)
    assert fit.transfer.gain == pytest.approx(1.0, abs=0.01)
    lag = fit.dead_time + 2 * fit.transfer.damping / fit.transfer.natural_frequency
    assert lag == pytest.approx(0.04 + 2 * 1.1 / 12, abs=0.005)


def test_a_known_dead_time_is_kept():
    truth = TwoPoles(gain=1.0, natural_frequency=12.0, damping=1.1)
    assert identify_two_poles([record(truth, 0.04, 0.5)], dead_time=0.04).dead_time == 0.04


def test_tracks_are_recovered():
    wheels = WheelKinematics(0.0675, 0.33).wheel_speeds([[0.5, 0.4], [0.2, -1.0], [0.0, 0.7]])
    difference = side_difference(wheels, 0.0675)
    yaw_rate = np.array([0.4, -1.0, 0.7]) * 0.6
    assert identify_track(difference, yaw_rate) == pytest.approx(0.33 / 0.6)
    with pytest.raises(ValueError, match="sign"):
        identify_track(difference, -yaw_rate)


def test_fit_of_perfect_mean_and_worse():
    y = np.sin(np.arange(50.0))
    assert fit_percent(y, y) == 100.0
    assert fit_percent(y, np.full(50, y.mean())) == pytest.approx(0.0, abs=1e-9)
    assert fit_percent(y, -y) < 0
    with pytest.raises(ValueError, match="constant"):
        fit_percent(np.ones(5), np.ones(5))


@pytest.mark.parametrize(
    ("command", "output", "message"),
    [
        (np.ones(50), np.ones(50), "never changes"),
        (steps(1.0)[:10], steps(1.0)[:10], "at least"),
        (steps(1.0), np.full(170, np.nan), "not finite"),
        (steps(1.0), np.zeros(3), "equal length"),
    ],
)
def test_useless_records_are_refused(command, output, message):
    with pytest.raises(ValueError, match=message):
        Experiment("bad", DT, command, output)


def test_a_dead_sensor_is_refused():
    with pytest.raises(ValueError, match="sensor"):
        identify_two_poles([Experiment("dead", DT, steps(1.0), np.zeros(170))])
    with pytest.raises(ValueError, match="no experiments"):
        identify_two_poles([])
