"""The code in the recipes works as printed."""

import re
import textwrap
from pathlib import Path

import pytest

from diffdrive_mpc.bench.spec import SpecStudy, load_experiment
from diffdrive_mpc.bench.study import carry_out

RECIPES = (Path(__file__).parents[2] / "docs" / "recipes.md").read_text(encoding="utf-8")


def code(start):
    """Return the indented block of the recipes that starts with this text."""
    block = re.search(rf"^    {re.escape(start)}.*\n(?:(?:    .*)?\n)*", RECIPES, re.MULTILINE)
    return textwrap.dedent(block[0])


@pytest.mark.system
def test_recipe_of_a_study_runs(tmp_path, one_process):
    (tmp_path / "noise.yaml").write_text(code("title: Noise").replace("[0, 1, 2, 3, 4]", "[0]"))
    rows = carry_out(SpecStudy(load_experiment(tmp_path / "noise.yaml")), tmp_path / "noise")
    assert list(rows["part"]) == ["shipped"] * 2 + ["short"] * 4
    report = (tmp_path / "noise" / "experiment.md").read_text(encoding="utf-8")
    assert "| s | SSM, horizon=10 |" in report
    assert "| mean |" in report


def test_recipe_of_a_peer_drives():
    from diffdrive_mpc import load_trajectory, make_plant, simulate

    namespace = {"__name__": "recipe"}
    exec(code("# my_package/feed_forward.py").partition("# pyproject.toml of my_package")[0], namespace)
    run = simulate(namespace["FeedForwardController"](), make_plant("model:sm"), load_trajectory("s"))
    assert run.metrics.steps > 100


def test_recipe_of_a_backend_is_called(monkeypatch):
    import numpy as np

    from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate
    from diffdrive_mpc.mpc import controller
    from diffdrive_mpc.mpc.solver.backend import Solved
    from diffdrive_mpc.mpc.solver.report import SolverStatus

    namespace = {"__name__": "recipe", "np": np, "Solved": Solved, "SolverStatus": SolverStatus}
    exec(code("class ClippingBackend:"), namespace)
    monkeypatch.setattr(controller, "load_backend", lambda name: namespace["ClippingBackend"])
    driver = Controller(load_config("sm", {"solver.method": "daqp"}))
    run = simulate(driver, make_plant("model:sm"), load_trajectory("s"))
    assert run.metrics.completed and run.solver_methods.count("daqp") > 100
