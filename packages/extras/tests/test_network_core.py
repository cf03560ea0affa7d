"""The network in the core against its graph, in both precisions, and the controller that predicts with it."""

import ctypes
import subprocess

import casadi as ca
import numpy as np
import pytest
from network_parts import random_model

from diffdrive_mpc import Controller, ModelError, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.mpc.core.sources import core_texts

KINDS = [{}, {"units": 7, "dense": 5, "window": 3}, {"units": 33, "dense": 40, "window": 4}]


@pytest.fixture(scope="module", params=["double", "float"])
def step(request, tmp_path_factory):
    """The step in C, compiled for itself with guards around its memory."""
    folder = tmp_path_factory.mktemp(request.param)
    for name, text in core_texts().items():
        (folder / name).write_text(text)
    if request.param == "float":
        (folder / "ddmpc_sizes.h").write_text("#define DDMPC_FLOAT\n")
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-fno-math-errno", "-fPIC", "-shared"]
    subprocess.run(["gcc", *flags, "network.c", "-o", "network.so", "-lm"], cwd=folder, check=True)
    kind = np.float64 if request.param == "double" else np.float32
    return ctypes.CDLL(str(folder / "network.so")).ddmpc_network_step, kind


def call(step, model, window, gradient=True):
    function, kind = step
    own = model.compiled_step
    given = [np.array(part, dtype=kind) for part in (np.zeros(2), window, own.parameters)]
    after, by_x, by_window = np.full(2, 7, kind), np.full(4, 7, kind), np.full(np.size(window) * 2, 7, kind)
    # What lies behind its memory must stay as it is.
    work = np.full(own.work + 64, 1e30, dtype=kind)
    pointer = ctypes.POINTER(ctypes.c_double if kind is np.float64 else ctypes.c_float)
    arguments = (pointer * 3)(*(part.ctypes.data_as(pointer) for part in given))
    results = (pointer * 3)(after.ctypes.data_as(pointer))
    if gradient:
        results[1], results[2] = by_x.ctypes.data_as(pointer), by_window.ctypes.data_as(pointer)
    function(arguments, results, None, work.ctypes.data_as(pointer), 0)
    assert (work[own.work :] == kind(1e30)).all()
    return after, by_x, by_window.reshape(-1, 2).T


@pytest.mark.parametrize("kind", KINDS, ids=["papers", "small", "wide"])
def test_the_core_computes_the_graph_and_its_gradient(step, kind):
    model, rounding = random_model(**kind), 1e-12 if step[1] is np.float64 else 2e-4
    symbol = ca.MX.sym("window", 2 * (model.memory + 1))
    gradient = ca.Function("by", [symbol], [ca.jacobian(model.step(ca.MX(2, 1), symbol), symbol)])
    random = np.random.default_rng(0)
    # Beyond any command, too: gates that are shut and open for good.
    for scale in (0.5, 5.0, 500.0):
        window = scale * random.normal(size=symbol.numel())
        after, by_x, by_window = call(step, model, window)
        size = max(1.0, np.abs(gradient(window).full()).max())
        assert after == pytest.approx(model.step(0, window).full().ravel(), abs=rounding)
        assert by_window == pytest.approx(gradient(window).full(), abs=rounding * size)
        assert (by_x == 0).all()
        # With and without the gradient the compiler may round differently.
        assert call(step, model, window, gradient=False)[0] == pytest.approx(after, abs=rounding)


def test_a_command_that_is_no_number_spoils_the_output(step):
    window = np.zeros(40)
    window[7] = np.nan
    after, _, _ = call(step, random_model(), window)
    assert np.isnan(after).all()


def test_other_networks_are_refused_in_one_line():
    for kind, said in (({"layers": 2}, "2 layers with tanh"), ({"activation": "relu"}, "1 layers with relu")):
        with pytest.raises(ModelError, match=said):
            Controller(load_config("ssm"), model=random_model(**kind))


@pytest.mark.parametrize("trajectory", ["square", "s"])
def test_the_shipped_network_keeps_to_the_path(trajectory):
    """Within one and a half of the SSM's error."""
    errors = {}
    for name in ("ssm", "lstm"):
        run = simulate(Controller(load_config(name)), make_plant("mujoco", seed=5), load_trajectory(trajectory))
        errors[name] = run.metrics.position_rmse_m
        assert set(run.modes) <= {"TRACKING", "FINISHED"}
    assert errors["lstm"] < 1.5 * errors["ssm"]
