"""Files of every kind that the product reads, changed here and there: refused in a line, or used without harm."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import yaml

from diffdrive_mpc import Controller, VelocityModel, load_config, load_model, load_trajectory, make_plant
from diffdrive_mpc.app.command_line.file_kinds import KINDS
from diffdrive_mpc.app.tune.tune_file import load_plan
from diffdrive_mpc.bench.spec import load_experiment
from diffdrive_mpc.models.checked_yaml import read_yaml
from diffdrive_mpc.models.file_kind import PACKAGE
from diffdrive_mpc.models.logs.mapping import load_mapping
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.sim.disturbances.scenario import load_scenario
from diffdrive_mpc.sim.ros.simulated_base import load_base_settings
from diffdrive_mpc_extras.campaign.campaign_file import load_campaign, load_conditions
from diffdrive_mpc_extras.proof.proof_file import load_proof
from diffdrive_mpc_extras.terrain.terrain_file import load_terrain
from diffdrive_mpc_extras.turn_costs import load_turn_costs
from diffdrive_mpc_extras.turn_costs.vehicle import load_drive_constants, load_vehicle
from diffdrive_mpc_extras.worlds.world import load_world
from diffdrive_mpc_monitor.judge import Judge
from diffdrive_mpc_monitor.rules import load_rules
from fuzz import mutation, shrink
from fuzz.case import Case, FaultError
from fuzz.controller import Life, checked_reference
from fuzz.promises import refused_or

_TESTS = Path(__file__).parents[1]
_SEEDS = {
    "base": "sim/ros/base.yaml",
    "campaign": "app/proof/default.yaml",
    "conditions": "bench/conditions.yaml",
    "experiment": "app/proof/default.yaml",
    "monitor": "mpc/monitor/rules/*.yaml",
    "proof": "app/proof/*.yaml",
    "terrain": "extras/terrain/terrains/*.yaml",
    "tune": "app/tune/default.yaml",
}
"""Shipped files of kinds that no shell completes, as patterns in the package."""


class YamlFuzzer:
    """Shipped files, and files of the tests of those kinds that ship none."""

    name, longest, count = "yaml", 20.0, 500

    def draw(self, random: Random) -> Case:
        """A file, and what is changed in it."""
        kind = random.choice(doors())
        files = seeds(kind)
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
        """Read it, and use what was read."""
        source = PACKAGE / case["file"]
        text = source.read_bytes()
        if case["edits"]:
            tree = mutation.edited_tree(yaml.safe_load(text), case["edits"])
            text = yaml.safe_dump(tree, allow_unicode=True, sort_keys=False).encode("utf-8", "surrogatepass")
        text = mutation.edited_bytes(text, case["raw"])
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, source.name)
            path.write_bytes(text)
            refused_or(lambda: _DOORS.get(case["kind"], read_yaml)(path))

    def simpler(self, case: Case) -> Iterator[Case]:
        """Fewer changes."""
        for key in ("edits", "raw"):
            for fewer in shrink.fewer(case[key]):
                yield {**case, key: fewer}


def doors() -> list[str]:
    """Kinds of files; one that is new is at least read."""
    return sorted({*KINDS, *_DOORS})


@cache
def seeds(kind: str) -> list[str]:
    """Files of a kind, as paths in the package."""
    found = KINDS[kind].files if kind in KINDS else sorted(PACKAGE.glob(_SEEDS[kind]))
    return [str(path.relative_to(PACKAGE)) for path in found]


def _controller(path: Path) -> None:
    life = Life(Controller(load_config(path)), [load_trajectory("circle")])
    life.start(0, 0.0)
    life.drive(10)
    life.tick(0.0202, {"pose": {"shift": [0.3, 0.0, 0.0]}})
    life.drive(10)


def _trajectory(path: Path) -> None:
    checked_reference(load_trajectory(path), TrajectoryLimits.of_robot())


def _model(path: Path) -> None:
    model = load_model(path)
    if isinstance(model, VelocityModel):
        discrete = model.discretise(0.0202)
        for values in (discrete.A, discrete.B0, discrete.B1, discrete.C):
            if not np.isfinite(values).all():
                raise FaultError("model: discretised, it is not finite")
    life = Life(Controller(load_config("ssm", {"horizon": 10}), model=model), [load_trajectory("circle")])
    life.start(0, 0.0)
    life.drive(5)


def _plant(name: str, **options: Any) -> None:
    plant = make_plant(name, seed=1, **options)
    plant.reset((0.0, 0.0, 0.0))
    for k in range(5):
        plant.advance((0.3, 0.5 * math.sin(k)))
        measured = plant.measure()
        if measured.wheel_twist is not None and not np.isfinite(measured.wheel_twist.value).all():
            raise FaultError("plant: its encoders are not finite")
    if not np.isfinite(plant.true_pose).all():
        raise FaultError("plant: its pose is not finite")


_DOORS: dict[str, Callable[[Path], object]] = {
    "controller": _controller,
    "trajectory": _trajectory,
    "model": _model,
    "mapping": load_mapping,
    "robot": lambda path: _plant(f"mujoco:{path}"),
    "surface": lambda path: _plant("mujoco", surface=path),
    "sensors": lambda path: _plant("mujoco", sensors=path),
    "scenario": lambda path: (load_scenario(path), _plant("mujoco", scenario=path)),
    "campaign": load_campaign,
    "experiment": load_experiment,
    "proof": load_proof,
    "tune": load_plan,
    "conditions": load_conditions,
    "monitor": lambda path: Judge(load_rules(path)).command(0.0, 0.0, 0.1, 0.1),
    "world": load_world,
    "drive": load_drive_constants,
    "terrain": load_terrain,
    "turn-costs": load_turn_costs,
    "vehicle": load_vehicle,
    "base": load_base_settings,
}
