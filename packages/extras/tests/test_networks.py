"""Networks on past commands: equations, files, core, training and errors."""

import ctypes
import subprocess

import casadi as ca
import numpy as np
import pytest
import yaml
from identification_parts import check_written, differences
from log_parts import drive, write_csv, write_mapping

from diffdrive_mpc import (
    ConfigError,
    Controller,
    ModelError,
    identify,
    load_config,
    load_model,
    load_trajectory,
    make_plant,
    simulate,
)
from diffdrive_mpc.models.load import load_base_effects
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.mpc.core.sources import core_texts
from diffdrive_mpc_extras.networks.network import Architecture, Network, fit_percent, rmse, split_windows, windows_of
from diffdrive_mpc_extras.networks.network_model import network_content, network_model, write_network
from diffdrive_mpc_extras.networks.training import train, training_settings

DT = 0.0202


def random_network(seed=0, scale=0.4, **options):
    """Draw an untrained network whose steady-state gain matrix is the identity."""
    architecture, rng = Architecture(**options), np.random.default_rng(seed)
    weights = {
        name: rng.normal(size=shape) * (scale if len(shape) > 1 else 0.2) for name, shape in architecture.shapes.items()
    }
    network = Network(architecture, weights)
    # Scale the output layer so that the gain matrix at rest is the identity.
    gain = network_gain(network)
    weights["output"] = weights["output"] @ np.linalg.inv(gain)
    weights["output_offset"] = np.array([0.03, -0.02])
    return Network(architecture, weights)


def network_gain(network, step=1e-5):
    """Compute the gain (2, 2) from central differences: a row per input, a column per output."""
    windows = np.array([np.tile(step * unit, (network.architecture.window, 1)) for unit in (*np.eye(2), *-np.eye(2))])
    outputs = network(windows)
    return (outputs[:2] - outputs[2:]) / (2 * step)


def random_model(seed=0, scale=0.4, **options):
    return network_model("network", random_network(seed, scale, **options), DT)


PROVENANCE = {"origin": "assumed", "source": "random numbers"}


def write(path, network):
    write_network(path, network, network_content(network, name="mine", sample_time=DT, provenance=PROVENANCE))


def evaluate_by_definition(network, window):
    """Evaluate the textbook equations of an LSTM for one window, unit by unit."""
    w, n = network.weights, network.architecture.units

    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    output, cell = np.zeros(n), np.zeros(n)
    for command in window:
        sums = command @ w["input_0"] + output @ w["recurrent_0"] + w["gate_offset_0"]
        for j in range(n):
            input_gate, forget_gate, candidate, output_gate = sums[j::n]
            cell[j] = sigmoid(forget_gate) * cell[j] + sigmoid(input_gate) * np.tanh(candidate)
            output[j] = sigmoid(output_gate) * np.tanh(cell[j])
    return np.tanh(output @ w["dense"] + w["dense_offset"]) @ w["output"] + w["output_offset"]


def test_network_agrees_with_the_textbook_equations():
    network = random_network(units=5, dense=4, window=6)
    windows = np.random.default_rng(1).normal(size=(3, 6, 2))
    expected = np.array([evaluate_by_definition(network, window) for window in windows])
    assert network(windows) == pytest.approx(expected, abs=1e-13)


@pytest.mark.parametrize("options", [{}, {"layers": 2, "units": 6}, {"activation": "relu", "units": 6, "dense": 9}])
def test_symbolic_step_and_its_gradient_agree_with_the_numeric_network(options):
    network = random_network(window=7, **options)
    model = network_model("network", network, DT)
    window = np.random.default_rng(2).normal(size=(7, 2))
    expected = network(window[None])[0] - network.rest_output
    assert model.step([9.0, 9.0], window.ravel()).full().ravel() == pytest.approx(expected, abs=1e-13)
    symbol = ca.MX.sym("window", 14)
    result = ca.Function("by", [symbol], [ca.jacobian(model.step(ca.MX(2, 1), symbol), symbol)])(window.ravel()).full()
    slopes = differences(lambda point: network(point.reshape(1, 7, 2)), window.ravel())
    assert result == pytest.approx(slopes, abs=1e-8)


def test_model_is_at_rest_under_zero_commands_and_has_the_gain_of_the_network():
    model = random_model()
    assert np.abs(model.network.rest_output).max() > 1e-3, "the subtraction must matter"
    assert model.step(0, 0).full().ravel() == pytest.approx(np.zeros(2), abs=1e-13)
    assert model.dc_gain == pytest.approx(network_gain(model.network).T, abs=1e-6)


def test_files_restore_the_network_and_are_reproducible(tmp_path):
    network = random_network()
    for name in ("first", "second"):
        write(tmp_path / f"{name}.yaml", network)
    assert (tmp_path / "first.npz").read_bytes() == (tmp_path / "second.npz").read_bytes()
    loaded = load_model(tmp_path / "first.yaml")
    windows = np.random.default_rng(4).normal(size=(5, 20, 2))
    # The file stores weights in single precision, like the training.
    assert loaded.network(windows) == pytest.approx(network(windows), abs=1e-5)
    assert loaded.provenance["source"] == "random numbers"
    assert load_base_effects(tmp_path / "first.yaml") == load_base_effects("ssm")


def test_damaged_or_inconsistent_files_raise_config_error(tmp_path):
    path = tmp_path / "mine.yaml"
    write(path, random_network())
    weights = (tmp_path / "mine.npz").read_bytes()
    (tmp_path / "mine.npz").write_bytes(weights[:-1] + b"x")
    with pytest.raises(ConfigError, match="has another digest"):
        load_model(path)
    (tmp_path / "mine.npz").unlink()
    with pytest.raises(ConfigError, match="keep both files together"):
        load_model(path)
    (tmp_path / "mine.npz").write_bytes(weights)
    path.write_text(path.read_text().replace("units: 30", "units: 31"))
    with pytest.raises(ConfigError, match=r"input_0 has float32 in shape \(2, 120\), expected .* in \(2, 124\)"):
        load_model(path)
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"layer": 2}))
    with pytest.raises(ConfigError, match="unknown key 'layer'"):
        load_model(path)


ARCHITECTURES = [{}, {"units": 7, "dense": 5, "window": 3}, {"units": 33, "dense": 40, "window": 4}]


@pytest.fixture(scope="module", params=["double", "float"])
def step(request, tmp_path_factory):
    """C function of the step, compiled separately, and its floating-point type."""
    folder = tmp_path_factory.mktemp(request.param)
    for name, text in core_texts().items():
        (folder / name).write_text(text)
    if request.param == "float":
        (folder / "ddmpc_sizes.h").write_text("#define DDMPC_FLOAT\n")
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-fno-math-errno", "-fPIC", "-shared"]
    subprocess.run(["gcc", *flags, "network.c", "-o", "network.so", "-lm"], cwd=folder, check=True)
    dtype = np.float64 if request.param == "double" else np.float32
    return ctypes.CDLL(str(folder / "network.so")).ddmpc_network_step, dtype


def call(step, model, window, gradient=True):
    function, dtype = step
    compiled = model.compiled_step
    inputs = [np.array(part, dtype=dtype) for part in (np.zeros(2), window, compiled.parameters)]
    next_x, by_x, by_window = np.full(2, 7, dtype), np.full(4, 7, dtype), np.full(np.size(window) * 2, 7, dtype)
    # The values after the work memory must not change.
    work = np.full(compiled.work + 64, 1e30, dtype=dtype)
    pointer = ctypes.POINTER(ctypes.c_double if dtype is np.float64 else ctypes.c_float)
    arguments = (pointer * 3)(*(part.ctypes.data_as(pointer) for part in inputs))
    results = (pointer * 3)(next_x.ctypes.data_as(pointer))
    if gradient:
        results[1], results[2] = by_x.ctypes.data_as(pointer), by_window.ctypes.data_as(pointer)
    function(arguments, results, None, work.ctypes.data_as(pointer), 0)
    assert (work[compiled.work :] == dtype(1e30)).all()
    return next_x, by_x, by_window.reshape(-1, 2).T


@pytest.mark.parametrize("options", ARCHITECTURES, ids=["papers", "small", "wide"])
def test_core_agrees_with_the_symbolic_step_and_its_gradient(step, options):
    model, tolerance = random_model(**options), 1e-12 if step[1] is np.float64 else 2e-4
    symbol = ca.MX.sym("window", 2 * (model.memory + 1))
    gradient = ca.Function("by", [symbol], [ca.jacobian(model.step(ca.MX(2, 1), symbol), symbol)])
    rng = np.random.default_rng(0)
    # The largest scale saturates all gates.
    for scale in (0.5, 5.0, 500.0):
        window = scale * rng.normal(size=symbol.numel())
        next_x, by_x, by_window = call(step, model, window)
        size = max(1.0, np.abs(gradient(window).full()).max())
        assert next_x == pytest.approx(model.step(0, window).full().ravel(), abs=tolerance)
        assert by_window == pytest.approx(gradient(window).full(), abs=tolerance * size)
        assert (by_x == 0).all()
        # The code without the gradient may round differently.
        assert call(step, model, window, gradient=False)[0] == pytest.approx(next_x, abs=tolerance)


def test_nan_command_gives_nan_output(step):
    window = np.zeros(40)
    window[7] = np.nan
    next_x, _, _ = call(step, random_model(), window)
    assert np.isnan(next_x).all()


def test_unsupported_architecture_raises_model_error():
    for options, message in (({"layers": 2}, "2 layers with tanh"), ({"activation": "relu"}, "1 layers with relu")):
        with pytest.raises(ModelError, match=message):
            Controller(load_config("ssm"), model=random_model(**options))


@pytest.mark.parametrize("trajectory", ["square", "s"])
def test_shipped_network_tracks_with_at_most_twice_the_error_of_the_ssm(trajectory):
    """A controller with a network does not estimate the delay."""
    errors = {}
    for name in ("ssm", "lstm"):
        run = simulate(Controller(load_config(name)), make_plant("mujoco", seed=5), load_trajectory(trajectory))
        errors[name] = run.metrics.position_rmse_m
        assert set(run.modes) <= {"TRACKING", "FINISHED"}
    assert errors["lstm"] < 2.0 * errors["ssm"]


SMALL = Architecture(window=8, units=8, dense=8)
SHORT = training_settings().model_copy(update={"max_epochs": 3, "dropout": 0.0, "decay": 0.0, "rate": 0.01})


def saturating_drive(seed, count=3000, dt=0.05):
    """Simulate a lag whose gain decreases with the command, which a linear model cannot represent."""
    rng = np.random.default_rng(seed)
    commands = np.repeat(rng.uniform(-1, 1, (count // 10, 2)), 10, axis=0)
    twist = np.zeros((count, 2))
    for k in range(1, count):
        twist[k] = twist[k - 1] + 0.4 * (np.tanh(1.5 * commands[k - 1]) - twist[k - 1])
    return SampledExperiment("drive", dt, commands, twist, np.ones((count, 2), dtype=bool))


def train_small_network(seed=0, **changes):
    windows = windows_of([saturating_drive(0)], SMALL.window)
    training, validation = split_windows(windows, (0.8, 0.2))
    return train(SMALL, training, validation, SHORT.model_copy(update={"seed": seed, **changes}))


def test_windows_contain_the_commands_before_each_reading():
    experiment = saturating_drive(0, count=30)
    experiment.counts[12] = False
    windows = windows_of([experiment], 8)
    assert len(windows) == 30 - 8 - 1
    np.testing.assert_array_equal(windows.commands[0], experiment.inputs[:8])
    np.testing.assert_array_equal(windows.twists[0], experiment.outputs[8])
    # The window of the invalid reading is omitted; the other windows do not change.
    np.testing.assert_array_equal(windows.commands[4], experiment.inputs[5:13])
    np.testing.assert_array_equal(windows.twists[4], experiment.outputs[13])
    parts = split_windows(windows, (0.5, 0.3, 0.2))
    assert sum(map(len, parts)) == len(windows)


def test_network_fits_better_than_any_linear_model():
    trained_network = train_small_network()
    windows = windows_of([saturating_drive(1)], SMALL.window)
    regressors = np.hstack([windows.commands.reshape(len(windows), -1), np.ones((len(windows), 1))])
    # The linear model is fitted to the test data.
    coefficients = np.linalg.lstsq(regressors, windows.twists, rcond=None)[0]
    linear = np.sqrt(np.mean((regressors @ coefficients - windows.twists) ** 2, axis=0))
    assert (rmse(trained_network.network, windows) < 0.7 * linear).all()
    assert fit_percent(trained_network.network, windows).min() > 90.0
    assert (
        trained_network.losses[trained_network.best_step // 20]
        == trained_network.losses.min()
        < 0.1 * trained_network.losses[0]
    )


def test_weights_are_reproducible_by_seed():
    first, repeated, second = (train_small_network(seed, max_epochs=1).network.weights for seed in (3, 3, 4))
    assert all(np.array_equal(first[name], repeated[name]) for name in first)
    assert not np.array_equal(first["dense"], second["dense"])


def test_identification_from_a_log_writes_a_network_that_a_controller_loads(tmp_path):
    write_mapping(tmp_path / "map.yaml")
    log = write_csv(tmp_path / "drive.csv", drive(seconds=120.0))
    identification = identify(log, tmp_path / "map.yaml", "lstm")
    assert identification.report.fitted.validation.fit_percent.min() > 80.0
    assert "LSTM from drive.csv" in identification.report.markdown()
    model = check_written(identification, tmp_path / "mine", 1e-5)
    assert model.dt == 0.02 and model.network.architecture == Architecture()
