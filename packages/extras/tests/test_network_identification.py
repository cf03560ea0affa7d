"""Training: what it recovers, that a seed repeats it, and the way from a log to a network that drives."""

import sys

import numpy as np
import pytest
from log_parts import drive, write_csv, write_mapping

from diffdrive_mpc import ConfigError, Controller, MissingPackageError, ModelError, identify, load_config, load_model
from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.sim.plants.base_motion import BaseMotion
from diffdrive_mpc_extras.networks.network import Architecture, divided, fit_percent, rmse, windows_of
from diffdrive_mpc_extras.networks.training import train, training_settings

SMALL = Architecture(window=8, units=8, dense=8)
SHORT = training_settings().model_copy(update={"most_epochs": 3, "dropout": 0.0, "decay": 0.0, "rate": 0.01})


def saturating_drive(seed, count=3000, dt=0.05):
    """A lag whose gain falls with the command, which no linear model has."""
    random = np.random.default_rng(seed)
    commands = np.repeat(random.uniform(-1, 1, (count // 10, 2)), 10, axis=0)
    twist = np.zeros((count, 2))
    for k in range(1, count):
        twist[k] = twist[k - 1] + 0.4 * (np.tanh(1.5 * commands[k - 1]) - twist[k - 1])
    return SampledExperiment("drive", dt, commands, twist, np.ones((count, 2), dtype=bool))


def trained(seed=0, **changes):
    windows = windows_of([saturating_drive(0)], SMALL.window)
    training, validation = divided(windows, (0.8, 0.2))
    return train(SMALL, training, validation, SHORT.model_copy(update={"seed": seed, **changes}))


def test_the_windows_are_the_commands_before_each_reading():
    experiment = saturating_drive(0, count=30)
    experiment.counts[12] = False
    windows = windows_of([experiment], 8)
    assert len(windows) == 30 - 8 - 1
    np.testing.assert_array_equal(windows.commands[0], experiment.inputs[:8])
    np.testing.assert_array_equal(windows.twists[0], experiment.outputs[8])
    # The reading that does not count is left out, and nothing moves because of it.
    np.testing.assert_array_equal(windows.commands[4], experiment.inputs[5:13])
    np.testing.assert_array_equal(windows.twists[4], experiment.outputs[13])
    parts = divided(windows, (0.5, 0.3, 0.2))
    assert sum(map(len, parts)) == len(windows)


def test_it_learns_what_no_linear_model_can_say():
    found = trained()
    other = windows_of([saturating_drive(1)], SMALL.window)
    flat = np.hstack([other.commands.reshape(len(other), -1), np.ones((len(other), 1))])
    best = np.linalg.lstsq(flat, other.twists, rcond=None)[0]
    linear = np.sqrt(np.mean((flat @ best - other.twists) ** 2, axis=0))
    assert (rmse(found.network, other) < 0.7 * linear).all(), "the linear one was even fitted to these drives"
    assert fit_percent(found.network, other).min() > 90.0
    assert found.losses[found.best_step // 20] == found.losses.min() < 0.1 * found.losses[0]


def test_a_seed_gives_the_same_weights_and_another_one_others():
    one, same, other = (trained(seed, most_epochs=1).network.weights for seed in (3, 3, 4))
    assert all(np.array_equal(one[name], same[name]) for name in one)
    assert not np.array_equal(one["dense"], other["dense"])


def test_it_stops_where_validation_does_not_improve():
    """With nothing to learn from, the first looks are as good as any."""
    windows = windows_of([saturating_drive(0)], SMALL.window)
    training, validation = divided(windows, (0.8, 0.2))
    noise = np.random.default_rng(0).normal(size=training.twists.shape)
    lost = train(SMALL, type(training)(training.commands, noise), validation, SHORT.model_copy(update={"patience": 3}))
    assert lost.steps - lost.best_step <= 3 * SHORT.validation_every
    assert lost.steps < 3 * len(training) // SHORT.batch


def test_from_a_log_to_a_network_that_a_controller_loads(tmp_path):
    write_mapping(tmp_path / "map.yaml")
    log = write_csv(tmp_path / "drive.csv", drive(seconds=120.0))
    found = identify(log, tmp_path / "map.yaml", "lstm")
    assert found.report.fitted.validation.fit_percent.min() > 80.0
    assert found.report.as_json()["model"] == "lstm"
    assert "LSTM from drive.csv" in found.report.markdown()
    found.write(tmp_path / "mine")
    model = load_model(tmp_path / "mine" / "model.yaml")
    commands = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    assert model.simulate(commands) == pytest.approx(found.model.simulate(commands), abs=1e-5)
    config = load_config(tmp_path / "mine" / "config.yaml")
    assert config.sample_time == model.dt == 0.02
    assert Controller(config).model.network.architecture == Architecture()


def test_what_does_not_go_with_a_network_is_said(tmp_path):
    write_mapping(tmp_path / "map.yaml")
    log = write_csv(tmp_path / "drive.csv", drive(seconds=20.0))
    with pytest.raises(ConfigError, match="they stand around an sm, not an lstm"):
        identify(log, tmp_path / "map.yaml", "lstm", effects=True)
    with pytest.raises(ConfigError, match="order 2: only ssm has a choice"):
        identify(log, tmp_path / "map.yaml", "lstm", order=2)


def test_without_the_extra_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(MissingPackageError) as refused:
        identify(tmp_path / "never read.csv", None, "lstm")
    assert str(refused.value) == "training a network needs JAX and Optax: pip install 'diffdrive-mpc[learn]'"


def test_motion_of_a_network_plant_equals_its_simulation():
    model, random = load_model("lstm"), np.random.default_rng(0)
    motion, commands = BaseMotion(model, BaseEffects(), model.dt), random.uniform(-1, 1, (50, 2))
    before = np.vstack([np.zeros(2), *(motion.advance(command).wheels for command in commands)])
    assert before[:-1] == pytest.approx(model.simulate(commands), abs=1e-12)
    with pytest.raises(ModelError, match=r"as a plant of 0\.04 s"):
        BaseMotion(model, BaseEffects(), 0.04)
