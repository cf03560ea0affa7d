"""Networks on past commands: what they compute, their files, and what is refused."""

import casadi as ca
import numpy as np
import pytest
import yaml
from network_parts import DT, network_gain, random_model, random_network

from diffdrive_mpc import ConfigError, ModelError, load_model
from diffdrive_mpc.models.load import load_base_effects, load_linear_model
from diffdrive_mpc_extras.networks.network import Architecture, Network
from diffdrive_mpc_extras.networks.network_model import network_content, network_model, write_network

PROVENANCE = {"origin": "assumed", "source": "random numbers"}


def write(path, network):
    write_network(path, network, network_content(network, name="mine", sample_time=DT, provenance=PROVENANCE))


def one_window(network, window):
    """The textbook's equations, unit by unit."""
    w, n = network.weights, network.architecture.units

    def squash(x):
        return 1 / (1 + np.exp(-x))

    out, cell = np.zeros(n), np.zeros(n)
    for command in window:
        sums = command @ w["input_0"] + out @ w["recurrent_0"] + w["gate_offset_0"]
        for j in range(n):
            enter, keep, candidate, leave = sums[j::n]
            cell[j] = squash(keep) * cell[j] + squash(enter) * np.tanh(candidate)
            out[j] = squash(leave) * np.tanh(cell[j])
    return np.tanh(out @ w["dense"] + w["dense_offset"]) @ w["output"] + w["output_offset"]


def test_the_papers_network_has_5018_parameters():
    """4 x 30 x (2 + 30 + 1) + 32 x 31 + 2 x 33."""
    assert Architecture().parameters == 5018
    assert load_model("lstm").network.architecture == Architecture()


def test_it_computes_what_the_textbook_says():
    network = random_network(units=5, dense=4, window=6)
    windows = np.random.default_rng(1).normal(size=(3, 6, 2))
    assert network(windows) == pytest.approx(np.array([one_window(network, window) for window in windows]), abs=1e-13)


@pytest.mark.parametrize("kind", [{}, {"layers": 2, "units": 6}, {"activation": "relu", "units": 6, "dense": 9}])
def test_its_graph_and_its_gradient_are_those_of_its_numbers(kind):
    network = random_network(window=7, **kind)
    model = network_model("network", network, DT)
    window = np.random.default_rng(2).normal(size=(7, 2))
    says = network(window[None])[0] - network.at_rest
    assert model.step([9.0, 9.0], window.ravel()).full().ravel() == pytest.approx(says, abs=1e-13)
    symbol, step = ca.MX.sym("window", 14), 1e-6
    found = ca.Function("by", [symbol], [ca.jacobian(model.step(ca.MX(2, 1), symbol), symbol)])(window.ravel()).full()
    moved = window.ravel() + step * np.vstack([np.eye(14), -np.eye(14)])
    there = network(moved.reshape(-1, 7, 2))
    assert found == pytest.approx((there[:14] - there[14:]).T / (2 * step), abs=1e-8)


def test_the_model_rests_and_its_gain_is_that_of_small_commands():
    model = random_model()
    assert np.abs(model.network.at_rest).max() > 1e-3, "else there is nothing to take off"
    assert model.step(0, 0).full().ravel() == pytest.approx(np.zeros(2), abs=1e-13)
    assert model.dc_gain == pytest.approx(network_gain(model.network).T, abs=1e-6)


def test_its_file_brings_it_back_and_is_the_same_each_time(tmp_path):
    network = random_network()
    for name in ("one", "other"):
        write(tmp_path / f"{name}.yaml", network)
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "other.npz").read_bytes()
    found = load_model(tmp_path / "one.yaml")
    windows = np.random.default_rng(4).normal(size=(5, 20, 2))
    # It is kept in the precision that it is trained in.
    assert found.network(windows) == pytest.approx(network(windows), abs=1e-5)
    assert found.provenance["source"] == "random numbers"
    assert load_base_effects(tmp_path / "one.yaml") == load_base_effects("ssm")


def test_files_that_are_not_whole_are_refused_in_one_line(tmp_path):
    path = tmp_path / "mine.yaml"
    write(path, random_network())
    weights = (tmp_path / "mine.npz").read_bytes()
    (tmp_path / "mine.npz").write_bytes(weights[:-1] + b"x")
    with pytest.raises(ConfigError, match="is not the file that was written with it"):
        load_model(path)
    (tmp_path / "mine.npz").unlink()
    with pytest.raises(ConfigError, match="keep both files together"):
        load_model(path)
    (tmp_path / "mine.npz").write_bytes(weights)
    path.write_text(path.read_text().replace("units: 30", "units: 31"))
    with pytest.raises(ConfigError, match=r"input_0 holds float32 in shape \(2, 120\), expected .* in \(2, 124\)"):
        load_model(path)
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"layer": 2}))
    with pytest.raises(ConfigError, match="unknown key 'layer'"):
        load_model(path)


def test_what_a_network_cannot_do_is_said():
    model = load_model("lstm")
    with pytest.raises(ModelError, match="it is a function for samples of 0.0202 s"):
        model.discretise(0.01)
    with pytest.raises(ModelError, match="its dead time lies in its window"):
        model.with_extra_dead_time([0.02, 0.0])
    assert model.with_extra_dead_time([0.0, 0.0]) is model
    with pytest.raises(ModelError, match="here matrices are needed"):
        load_linear_model("lstm")
    weights = dict(random_network().weights)
    with pytest.raises(ValueError, match="weights dense are missing"):
        Network(Architecture(), {name: value for name, value in weights.items() if name != "dense"})
    weights["dense"] = np.full_like(weights["dense"], np.nan)
    with pytest.raises(ValueError, match="not finite"):
        Network(Architecture(), weights)
