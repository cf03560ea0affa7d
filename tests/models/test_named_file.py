"""A shipped name or a path: one search and one sentence for every kind of file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from diffdrive_mpc import ConfigError, load_config, load_model, load_trajectory
from diffdrive_mpc.models.named_file import EntryFile, named_file, shipped_names
from diffdrive_mpc.sim.disturbances.scenario import load_scenario
from diffdrive_mpc.sim.plants.surface import Surface, load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set


@pytest.mark.parametrize(
    ("load", "kind", "near"),
    [
        (load_model, "model", "ssm"),
        (load_config, "configuration", "ssm"),
        (load_trajectory, "trajectory", "circle"),
        (load_scenario, "scenario", "push"),
        (load_surface, "surface", "slippery"),
        (load_sensor_set, "sensor set", "slam"),
    ],
)
def test_every_loader_refuses_in_the_same_words(load: Callable[[str], object], kind: str, near: str) -> None:
    wrong = near + near[-1]
    with pytest.raises(ConfigError) as caught:
        load(wrong)
    said = str(caught.value)
    assert said.startswith(f"unknown {kind} '{wrong}': give one of ")
    assert said.endswith(f" or the path of a {kind} file; did you mean '{near}'?")
    assert "\n" not in said


def test_a_shipped_name_comes_before_a_file_of_that_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shipped, own = tmp_path / "shipped", tmp_path / "own"
    for folder in (shipped, own):
        folder.mkdir()
    for name in ("wet", "dry", "notes"):
        (shipped / f"{name}.yaml").touch()
    (own / "wet").touch()
    (own / "mud").touch()
    monkeypatch.chdir(own)
    assert shipped_names(shipped) == ("dry", "notes", "wet")
    assert named_file("floor", shipped, "wet") == shipped / "wet.yaml"
    assert named_file("floor", shipped, "mud") == Path("mud")
    with pytest.raises(ConfigError, match=r"unknown floor 'notes': give one of dry, wet or the path of a floor file$"):
        named_file("floor", shipped, "notes", ("dry", "wet"))


def test_message_about_a_shipped_entry_names_file_and_entry(tmp_path: Path) -> None:
    slip = "slip: {yaw_gain: 1.0, wheel_yaw_gain: 0.9, longitudinal_gain: 1.0, side_slip: 0.0}"
    entries = EntryFile("surface", tmp_path / "surfaces.yaml")
    entries.path.write_text(f"firm: {{{slip}}}\nbad: {{{slip}, frictions: 0.8}}\n", encoding="utf-8")
    assert entries.names == ("bad", "firm")
    assert entries.load(Surface, "firm").slip.wheel_yaw_gain == 0.9
    with pytest.raises(ConfigError, match=r"surfaces\.yaml, entry 'bad': unknown key 'frictions'"):
        entries.load(Surface, "bad")
