"""Hybrid models: equations, gate, parameter file and training."""

import sys

import casadi as ca
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from identification_parts import check_written, data_of, differences
from log_parts import write_csv, write_mapping

from diffdrive_mpc import ConfigError, MissingPackageError, ModelError, identify, load_model
from diffdrive_mpc.models.load import load_base_effects, load_linear_model, model_path, read_model_file
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc_extras.hybrids.hybrid_model import (
    Correction,
    HybridFile,
    HybridModel,
    correction_content,
    hybrid_model,
    write_hybrid,
)
from diffdrive_mpc_extras.hybrids.training import hybrid_settings
from diffdrive_mpc_extras.model_comparison.model_comparison import compare_models
from refusals import one_line_error

DT = 0.0202


def random_correction(seed=0, size=0.02, units=5):
    """Draw a correction for the four states of an SM, with a size of a few per cent of their scale per sample."""
    rng = np.random.default_rng(seed)
    root = np.eye(6) + 0.2 * rng.normal(size=(6, 6))
    scale = np.array([0.5, 0.05, 0.8, 0.02, 0.5, 0.8])
    inward, outward = rng.normal(size=(6, units)), size * rng.normal(size=(units, 4))
    return Correction(scale, inward, outward, root.T @ root, 9.0, 36.0)


def random_hybrid(seed=0, **options):
    return hybrid_model("hybrid", load_model("sm").discretise(DT), random_correction(seed, **options))


MODEL = random_hybrid()
LINEAR = MODEL.linear
QUICK = hybrid_settings().model_copy(update={"units": 6, "decays": (1e-3,), "max_steps": 80})
FEATURES = st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(np.array)


def simulate_by_definition(commands, past):
    """Evaluate the equations of the model, element by element."""
    c, history, x, outputs = MODEL.correction, np.vstack([past, commands]), np.zeros(4), []
    for k in range(len(commands)):
        outputs.append(LINEAR.C @ x)
        rows = [k + len(past) - int(delay) for delay in LINEAR.delay]
        recent = np.array([history[row, j] for j, row in enumerate(rows)])
        previous = np.array([history[row - 1, j] for j, row in enumerate(rows)])
        z = np.array([*x, *recent]) / c.scale
        distance = sum(z[i] * c.shape[i, j] * z[j] for i in range(6) for j in range(6))
        fraction = min(max((distance - c.full) / (c.least - c.full), 0.0), 1.0)
        gate = 1.0 - 3.0 * fraction**2 + 2.0 * fraction**3
        units = [np.tanh(sum(c.inward[i, unit] * z[i] for i in range(6))) for unit in range(5)]
        change = [sum(c.outward[unit, n] * units[unit] for unit in range(5)) for n in range(4)]
        x = LINEAR.A @ x + LINEAR.B0 @ recent + LINEAR.B1 @ previous + c.scale[:4] * gate * change
    return np.array(outputs)


def features(x, recent):
    return np.array([*x, *recent]) / MODEL.correction.scale


def distance(z):
    return z @ MODEL.correction.shape @ z


def step_with_constant_command(model, x, recent):
    """Compute the next state (n,) from the state `x` for a constant command `recent` (2,)."""
    window = np.tile(recent, model.memory + 1)
    return np.asarray(model.step(x, window)).ravel()


def linear_step(x, recent):
    return LINEAR.A @ x + LINEAR.drive @ recent


def test_simulation_agrees_with_the_equations():
    rng = np.random.default_rng(0)
    past, commands = rng.normal(size=(MODEL.memory, 2)), np.repeat(rng.normal(size=(30, 2)), 5, axis=0)
    output = MODEL.simulate(commands, past=past)
    assert output == pytest.approx(simulate_by_definition(commands, past), abs=1e-12)
    assert np.abs(output - LINEAR.simulate(commands, past=past)).max() > 0.02, "the network must matter"


def test_gradient_agrees_with_central_differences():
    """Compare with the gate at 1, between 1 and 0, and at 0."""
    x, window = ca.SX.sym("x", 4), ca.SX.sym("w", 2 * (MODEL.memory + 1))
    arguments = ca.vertcat(x, window)
    jacobian = ca.Function("by", [arguments], [ca.jacobian(MODEL.step(x, window), arguments)])
    rng, regions = np.random.default_rng(1), set()
    for size in np.geomspace(0.1, 6.0, 20):
        point = size * rng.normal(size=arguments.numel()) * 0.5
        point[:4] *= MODEL.correction.scale[:4]
        slopes = differences(lambda values: MODEL.step(values[:4], values[4:]).full(), point)
        assert jacobian(point).full() == pytest.approx(slopes, abs=1e-6)
        recent = [point[4:][2 * (MODEL.memory - int(delay)) + j] for j, delay in enumerate(LINEAR.delay)]
        regions.add(int(np.digitize(distance(features(point[:4], recent)), [9.0, 36.0])))
    assert regions == {0, 1, 2}


@given(FEATURES, st.floats(1.0, 50.0))
def test_step_far_from_the_data_equals_that_of_the_linear_model(direction, factor):
    size = distance(direction)
    if size < 1e-6:
        return
    z = direction * np.sqrt(factor * 36.0 * (1 + 1e-9) / size)
    x, recent = np.split(z * MODEL.correction.scale, [4])
    assert step_with_constant_command(MODEL, x, recent) == pytest.approx(linear_step(x, recent), rel=1e-12, abs=1e-13)


@given(FEATURES)
def test_change_by_the_network_is_bounded_and_unattenuated_near_the_data(z):
    x, recent = np.split(z * MODEL.correction.scale, [4])
    c = MODEL.correction
    change = (step_with_constant_command(MODEL, x, recent) - linear_step(x, recent)) / c.scale[:4]
    assert (np.abs(change) <= np.abs(c.outward).sum(axis=0) + 1e-9).all()
    if distance(z) <= c.full:
        assert change == pytest.approx(c.outward.T @ np.tanh(c.inward.T @ z), abs=1e-9)


def model_content():
    data = {"name": "mine", "structure": "hybrid", "sample_time": DT}
    data |= {"provenance": {"origin": "assumed", "source": "random numbers"}}
    data |= {"linear": read_model_file(model_path("sm")).model_dump()}
    return HybridFile.model_validate(data | {"correction": correction_content(random_correction())})


def test_file_restores_the_model_and_is_reproducible(tmp_path):
    for name in ("first", "second"):
        write_hybrid(tmp_path / f"{name}.yaml", model_content())
    assert (tmp_path / "first.yaml").read_bytes() == (tmp_path / "second.yaml").read_bytes()
    loaded = load_model(tmp_path / "first.yaml")
    assert isinstance(loaded, HybridModel)
    commands = np.repeat(np.random.default_rng(3).normal(size=(10, 2)), 8, axis=0)
    assert loaded.simulate(commands) == pytest.approx(MODEL.simulate(commands), abs=1e-6)
    assert loaded.provenance["source"] == "random numbers"
    assert load_base_effects(tmp_path / "first.yaml") == load_base_effects("ssm")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda data: data["correction"]["inward"].pop(),
            r"inward has shape \(5, 5\), expected \(6, 5\); train it again",
        ),
        (lambda data: data["correction"].update(scale=[0.0] * 6), "correction.scale.0: Input should be greater than 0"),
        (lambda data: data["correction"]["outward"][0].__setitem__(0, float("nan")), "should be a finite number"),
        (lambda data: data.update(structure="hybird"), "structure: expected one of .*hybrid.*, found 'hybird'"),
    ],
)
def test_invalid_file_raises_a_one_line_error(tmp_path, change, message):
    path = tmp_path / "mine.yaml"
    write_hybrid(path, model_content())
    data = yaml.safe_load(path.read_text())
    change(data)
    path.write_text(yaml.safe_dump(data))
    with one_line_error((ConfigError, ModelError), "mine", match=message):
        load_model(path)


def test_unsupported_call_of_a_hybrid_raises_model_error(tmp_path):
    write_hybrid(tmp_path / "mine.yaml", model_content())
    with pytest.raises(ModelError, match=r"a nonlinear model with sample time 0.0202 s"):
        MODEL.discretise(0.01)
    with pytest.raises(ModelError, match="a linear model is required"):
        load_linear_model(tmp_path / "mine.yaml")
    with pytest.raises(ModelError, match="unstable at rest"):
        hybrid_model("wild", LINEAR, random_correction(size=3.0))


def simulate_weak_supply(seed, seconds, lag=0.2, sag=0.5, dt=0.04):
    """Simulate a robot with a weak supply: the command of each channel reduces the gain of the other channel."""
    rng = np.random.default_rng(seed)
    commands = np.repeat(rng.uniform(-1, 1, (round(seconds / 0.8), 2)), round(0.8 / dt), axis=0)
    steady_twist, twist = commands * (1.0 - sag * np.abs(commands[:, ::-1])), np.zeros_like(commands)
    for k in range(1, len(commands)):
        twist[k] = twist[k - 1] + dt / lag * (steady_twist[k - 1] - twist[k - 1])
    noisy = twist + rng.normal(0, [0.003, 0.005], twist.shape)
    return Record(f"drive {seed}", 0.0, dt, commands, twist=noisy, yaw_rate=noisy[:, 1])


@pytest.fixture
def quick_training(monkeypatch):
    monkeypatch.setattr("diffdrive_mpc_extras.hybrids.finding.hybrid_settings", lambda: QUICK)


@pytest.mark.long
def test_network_fits_better_than_any_linear_model(quick_training):
    data = data_of(simulate_weak_supply(1, 60.0), simulate_weak_supply(2, 60.0))
    comparison = compare_models(data, ["sm", "hybrid"], parts=2)
    linear, hybrid = comparison.scores[1:]
    assert hybrid.states == linear.states == 4
    errors = [100.0 - comparison.fits(score) for score in (linear, hybrid)]
    assert (errors[1] < 0.6 * errors[0]).all()
    assert comparison.recommended.kind == "hybrid"


def test_identification_from_a_log_writes_a_hybrid_that_a_controller_loads(quick_training, tmp_path):
    record = simulate_weak_supply(5, 60.0)
    columns = {"t": record.dt * np.arange(len(record.command)), "v": record.twist[:, 0], "gyro": record.yaw_rate}
    columns |= {"v_ref": record.command[:, 0], "omega_ref": record.command[:, 1], "omega_wheels": record.yaw_rate}
    log = write_csv(tmp_path / "drive.csv", columns)
    sides = "encoders: {v: v, omega: omega_wheels}, gyro: {yaw_rate: gyro}"
    write_mapping(tmp_path / "map.yaml", f"columns: {{time: t, command: {{v: v_ref, omega: omega_ref}}, {sides}}}\n")
    identification = identify(log, tmp_path / "map.yaml", "hybrid")
    report = identification.report
    assert report.as_json()["model"] == "hybrid"
    assert "Parameters of the linear model in addition to a linear model with a network" in report.markdown()
    assert "chosen on held-out blocks" in report.markdown()
    refitted = report.fitted.predictor.refitted(report.data.validation, "gyro")
    assert isinstance(refitted, HybridModel)
    assert check_written(identification, tmp_path / "mine", 1e-5).dt == 0.04


def test_missing_jax_raises_missing_package_error_with_the_install_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(MissingPackageError) as error:
        identify(tmp_path / "never read.csv", None, "hybrid")
    assert str(error.value) == "training a hybrid needs JAX: pip install 'diffdrive-mpc[learn]'"
    with pytest.raises(ConfigError, match="structure hybrid has no effects; choose sm"):
        identify(tmp_path / "never read.csv", None, "hybrid", effects=True)
