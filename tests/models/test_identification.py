"""One channel is identified by output error: known truths come back, and useless records are refused."""

import numpy as np
import pytest
from identification_parts import DT, system, two_channels

from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.validation import fit_percent, pooled_fit_percent, simulate_experiment
from diffdrive_mpc.models.structures.channel import identify_channel
from diffdrive_mpc.models.structures.two_poles import TwoPolesForm
from diffdrive_mpc.models.wheels import WheelKinematics
from studies.shipped_models.model_fitting import identify_track, side_difference


def steps(level):
    return np.concatenate([np.zeros(20), np.full(90, level), np.zeros(60)])


def experiment(command, output):
    return SampledExperiment("one", DT, command[:, None], output[:, None], np.ones((len(output), 1), dtype=bool))


def record(transfer, dead_time, level, noise=0.0, seed=0):
    command = steps(level)
    model = two_channels(transfer, transfer, (dead_time, dead_time))
    clean = model.discretise(DT).simulate(np.column_stack([command, command]))[:, 0]
    return experiment(command, clean + noise * np.random.default_rng(seed).normal(size=len(clean)))


def identify(experiments, **known):
    return identify_channel(experiments, "v", limit=False, robust=False, **known)


@pytest.mark.parametrize(
    ("gain", "frequency", "damping", "dead_time"),
    [(1.0, 10.0, 1.3, 0.04), (0.6, 25.0, 0.7, 0.013), (1.07, 14.0, 1.0, 0.0), (2.0, 6.0, 0.9, 0.11)],
)
def test_known_truth_is_recovered_without_noise(gain, frequency, damping, dead_time):
    experiments = [record((gain, frequency, damping), dead_time, level) for level in (0.5, -0.8)]
    found = identify(experiments)
    simulated = [simulate_experiment(found.fit.system, one)[:, 0] for one in experiments]
    assert pooled_fit_percent([one.outputs[:, 0] for one in experiments], simulated) > 99.9
    assert found.parameters.value("gain") == pytest.approx(gain, rel=1e-3)
    assert found.parameters.value("natural_frequency") == pytest.approx(frequency, rel=2e-2)
    assert found.parameters.value("damping") == pytest.approx(damping, rel=2e-2)
    assert found.parameters.value("dead_time") == pytest.approx(dead_time, abs=1e-3)


def test_the_simulation_is_that_of_the_velocity_model():
    model = two_channels((0.9, 15.0, 0.8), (0.9, 15.0, 0.8), (0.047, 0.047))
    discrete = model.discretise(DT)
    command = 0.3 + steps(0.5)
    both = np.column_stack([command, command])
    start = np.full(2, command[0])
    outputs = discrete.simulate(both, discrete.settled_state(start), np.tile(start, (discrete.memory, 1)))
    simulated = simulate_experiment(
        system(model), SampledExperiment("both", DT, both, outputs, np.ones(both.shape, dtype=bool))
    )
    assert outputs == pytest.approx(simulated, abs=1e-9)


def test_noise_moves_the_lag_little():
    truth = (1.0, 12.0, 1.1)
    logs = [record(truth, 0.04, level, noise=0.01, seed=i) for i, level in enumerate((0.5, -0.5, 0.75, -0.75))]
    found = identify(logs).parameters
    assert found.value("gain") == pytest.approx(1.0, abs=0.01)
    lag = found.value("dead_time") + 2 * found.value("damping") / found.value("natural_frequency")
    assert lag == pytest.approx(0.04 + 2 * 1.1 / 12, abs=0.005)


def test_a_known_dead_time_is_kept():
    found = identify([record((1.0, 12.0, 1.1), 0.04, 0.5)], dead_time=0.04)
    assert found.fit.system.dead_time.tolist() == [0.04]
    assert found.parameters.names == ("gain", "natural_frequency", "damping")
    assert found.parameters.values == pytest.approx([1.0, 12.0, 1.1], rel=1e-3)


def test_a_bound_on_the_shorter_time_constant_is_kept():
    """A robot with one lag shows no second pole: without the bound it would run to the edge of what can be seen."""
    one_lag = [record((1.0, 80.0, 4.5), 0.04, level) for level in (0.5, -0.8)]
    found = identify(one_lag, form=TwoPolesForm(shortest=5e-3)).parameters
    frequency, damping = found.value("natural_frequency"), found.value("damping")
    assert 0.5 / (frequency * damping) == pytest.approx(5e-3, rel=1e-3)
    assert found.value("dead_time") + 2 * damping / frequency == pytest.approx(0.04 + 0.1125, abs=2e-3)


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


def test_useless_data_are_refused():
    with pytest.raises(ValueError, match="at least"):
        experiment(steps(1.0)[:4], steps(1.0)[:4])
    with pytest.raises(ValueError, match="not finite"):
        experiment(steps(1.0), np.full(170, np.nan))
    with pytest.raises(ValueError, match="same number of samples"):
        experiment(steps(1.0), np.zeros(30))
    with pytest.raises(ValueError, match="never changes"):
        identify([experiment(np.ones(50), np.ones(50))])
    with pytest.raises(ValueError, match="sensor"):
        identify([experiment(steps(1.0), np.zeros(170))])
    with pytest.raises(ValueError, match="no data"):
        identify([])
