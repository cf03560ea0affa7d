"""Fuzzer of YAML files: changed files of every kind are rejected in one line or used without a fault."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import yaml

from diffdrive_mpc import Controller, VelocityModel, load_config, load_model, load_trajectory, make_plant
from diffdrive_mpc.app.schemas import PACKAGE
from diffdrive_mpc.bench.spec import load_experiment
from diffdrive_mpc.models.logs.mapping import load_mapping
from diffdrive_mpc.models.stated_robot import load_stated_robot
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.sim.disturbances.scenario import load_scenario
from diffdrive_mpc.sim.ros.simulated_base import load_base_settings
from file_kinds import KINDS
from fuzz import mutation
from fuzz.case import Case, FaultError
from fuzz.controller import Session, checked_reference
from fuzz.promises import refused_or

_SEEDS = {"base": "sim/ros/base.yaml", "experiment": "../../studies/tracking/quick.yaml"}
"""Shipped files of the kinds that `file_kinds.KINDS` does not contain."""


class YamlFuzzer:
    """Fuzzer of changed files of every kind that the root package reads."""

    name, time_limit, count = "yaml", 20.0, 500

    def draw(self, random: Random) -> Case:
        """Draw a file and its changes."""
        kind = random.choice(sorted(LOADERS))
        files = sorted(seeds(kind))
        edits = [mutation.draw_tree_edit(random) for _ in range(random.choice((1, 1, 1, 2, 3, 6)))]
        raw = (
            [mutation.draw_bytes_edit(random) for _ in range(random.choice((1, 2, 5)))]
            if random.random() < 0.25
            else []
        )
        return {
            "kind": kind,
            "file": random.choice(files),
            "edits": [] if raw and random.random() < 0.5 else edits,
            "raw": raw,
        }

    def check(self, case: Case) -> None:
        """Read and use the changed file."""
        text = seeds(case["kind"])[case["file"]].encode()
        if case["edits"]:
            tree = mutation.edited_tree(yaml.safe_load(text), case["edits"])
            text = yaml.safe_dump(tree, allow_unicode=True, sort_keys=False).encode("utf-8", "surrogatepass")
        text = mutation.edited_bytes(text, case["raw"])
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"{case['file']}.yaml")
            path.write_bytes(text)
            refused_or(lambda: LOADERS[case["kind"]](path))


@cache
def seeds(kind: str) -> dict[str, str]:
    """Return the texts of the files of a kind by file name."""
    if kind in KINDS:
        return KINDS[kind].texts
    return {path.stem: path.read_text(encoding="utf-8") for path in sorted(PACKAGE.glob(_SEEDS[kind]))}


def _controller(path: Path) -> None:
    session = Session(Controller(load_config(path)), [load_trajectory("circle")])
    session.start(0, 0.0)
    session.drive(10)
    session.tick(0.0202, {"pose": {"shift": [0.3, 0.0, 0.0]}})
    session.drive(10)


def _trajectory(path: Path) -> None:
    checked_reference(load_trajectory(path), TrajectoryLimits.of_robot())


def _model(path: Path) -> None:
    model = load_model(path)
    if isinstance(model, VelocityModel):
        discrete = model.discretise(0.0202)
        for values in (discrete.A, discrete.B0, discrete.B1, discrete.C):
            if not np.isfinite(values).all():
                raise FaultError("model: the discrete model is not finite")
    session = Session(Controller(load_config("ssm", {"horizon": 10}), model=model), [load_trajectory("circle")])
    session.start(0, 0.0)
    session.drive(5)


def _plant(name: str, **options: Any) -> None:
    plant = make_plant(name, seed=1, **options)
    plant.reset((0.0, 0.0, 0.0))
    for k in range(5):
        plant.advance((0.3, 0.5 * math.sin(k)))
        measurement = plant.measure()
        if measurement.wheel_twist is not None and not np.isfinite(measurement.wheel_twist.value).all():
            raise FaultError("plant: its encoders are not finite")
    if not np.isfinite(plant.true_pose).all():
        raise FaultError("plant: its pose is not finite")


LOADERS: dict[str, Callable[[Path], object]] = {
    "controller": _controller,
    "trajectory": _trajectory,
    "model": _model,
    "mapping": load_mapping,
    "stated-robot": load_stated_robot,
    "robot": lambda path: _plant(f"mujoco:{path}"),
    "surface": lambda path: _plant("mujoco", surface=path),
    "sensors": lambda path: _plant("mujoco", sensors=path),
    "scenario": lambda path: (load_scenario(path), _plant("mujoco", scenario=path)),
    "experiment": load_experiment,
    "base": load_base_settings,
}
