"""Plants and simulator parts that packages register."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loop_parts import ConstantTwist, FeedForward

from diffdrive_mpc import MissingPackageError, make_plant
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import case_config, load_reference
from diffdrive_mpc.bench.run_row import row_of
from diffdrive_mpc.models import plug_ins
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.sim import Plant, Run, simulate
from diffdrive_mpc.sim.plants.make import physics_robot
from diffdrive_mpc.sim.plants.model_plant import ModelPlant
from diffdrive_mpc.sim.plants.plant import PlantAround
from diffdrive_mpc.sim.plants.plug_ins import RunColumns, SimulatorPart

REFERENCE = ConstantTwist(v=0.4, omega=0.5, duration=1.0)


class Walled(PlantAround):
    """Plant that ends the run 0.3 m after the end of the reference, and counts its `show` calls."""

    time_limit = 30.0

    def __init__(self, plant: Plant, limit: str) -> None:
        super().__init__(plant)
        self._limit, self.shown = limit, 0

    @property
    def records(self) -> dict[str, object]:
        return {"walled": self.shown}

    def show(self, controller: object) -> None:
        self.shown += 1

    def is_over(self, goal: FloatArray) -> bool:
        return self.time > 1.2

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plant, name)


class Kind(RunColumns):
    """Plants named "walled:NAME"; the added column numbers the ticks."""

    def make_plant(self, name: str, plant: str, **options: Any) -> Plant:
        return Walled(make_plant(plant, **options), name)

    def settings(self, name: str, plant: str) -> dict[str, object]:
        return {"horizon": 7}

    def reference(self, name: str, seed: int, limits: object) -> object:
        return load_trajectory("s") if name == "path" else None

    def series(self, run: Run) -> dict[str, FloatArray]:
        return {"walls": np.arange(len(run.time), dtype=float)}

    def row(self, run: Run) -> dict[str, object]:
        return {"shown": run.parts["walled"]}


class Counter:
    """A simulator part that counts the steps of the physics."""

    def __init__(self, first: float) -> None:
        self._first = first

    def reset(self) -> None:
        self.value = np.array([self._first])

    def take(self, motors: FloatArray) -> None:
        self.value = self.value + len(motors)

    def record(self, values: FloatArray) -> FloatArray:
        return values[:, 0]


def make_counter(sensor: Any, robot: object, seed: int) -> SimulatorPart:
    return Counter(sensor["first"])


@pytest.fixture
def registered_plug_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    kind, part = Kind(), SimpleNamespace(make_part=make_counter)
    parts = {"plants": {"walled": kind, "counter": part}, "columns": {"walled": kind, "counter": RunColumns()}}
    entries = {
        group: {name: SimpleNamespace(load=lambda result=result: result) for name, result in named.items()}
        for group, named in parts.items()
    }
    monkeypatch.setattr(plug_ins, "_entries", lambda group: entries.get(group, {}))
    plug_ins.plug_in.cache_clear()
    yield
    plug_ins.plug_in.cache_clear()


@pytest.fixture
def no_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Environment without installed packages."""
    monkeypatch.setattr(plug_ins, "_entries", lambda group: {})
    plug_ins.plug_in.cache_clear()
    yield
    plug_ins.plug_in.cache_clear()


@pytest.mark.usefixtures("no_packages")
@pytest.mark.parametrize(
    ("make", "part"),
    [
        (lambda: make_plant("world:slalom"), "plant 'world'"),
        (lambda: make_plant("mujoco", sensors="power"), "plant 'power'"),
        (lambda: Case(plant="world:slalom@mujoco:heavy"), "plant 'world'"),
    ],
)
def test_missing_package_of_a_plant_or_part_is_named_in_one_line(make: Any, part: str) -> None:
    with pytest.raises(MissingPackageError, match=rf"^{part} is in the package diffdrive-mpc-extras: pip install .*$"):
        make()


@pytest.mark.usefixtures("registered_plug_ins")
def test_registered_kind_creates_plants_around_others() -> None:
    plant = make_plant("walled:path@model:sm+0.04", seed=3)
    assert isinstance(plant, Walled) and isinstance(plant._plant, ModelPlant)
    assert physics_robot("walled:path@mujoco:heavy") == physics_robot("mujoco:heavy")
    with pytest.raises(ConfigError, match="unknown plant 'counter:3'"):
        make_plant("counter:3")


@pytest.mark.usefixtures("registered_plug_ins")
def test_plant_with_surroundings_shows_them_each_tick_and_ends_the_run() -> None:
    run = simulate(FeedForward(), make_plant("walled:a@model:ssm"), REFERENCE)
    assert run.parts["walled"] == len(run.time)
    assert 1.2 < run.time[-1] < 1.25
    assert run.columns["walls"].tolist() == list(range(len(run.time)))
    assert row_of(Case(), run)["shown"] == len(run.time)


@pytest.mark.usefixtures("registered_plug_ins")
def test_plant_provides_settings_and_a_path() -> None:
    case = Case(plant="walled:path@model:ssm")
    assert case.trajectory == case.plant and load_reference(case).name == "s"
    assert case_config(case).horizon == 7
    assert case_config(Case(plant="walled:path", overrides=(("horizon", 9),))).horizon == 9
    with pytest.raises(ConfigError, match="has its own path"):
        load_reference(Case(plant="walled:path", trajectory="cane"))
    with pytest.raises(ConfigError, match="the plant has no path; give a --trajectory"):
        load_reference(Case(plant="walled:none"))
    assert load_reference(Case(plant="walled:none", trajectory="cane")).name == "cane"


@pytest.mark.usefixtures("registered_plug_ins")
@pytest.mark.parametrize("scenario", ["none", "start_offset"])
def test_simulator_part_of_a_sensor_file_is_recorded(scenario: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("parts: {counter: {first: 5.0}}\n")
    plant = make_plant("mujoco", sensors=tmp_path / "mine.yaml", scenario=scenario)
    run = simulate(FeedForward(), plant, REFERENCE)
    counted = run.parts["counter"]
    assert len(counted) == len(run.time) and counted[0] == 5.0
    assert np.unique(np.diff(counted)).size == 1 and counted[1] > 6.0
