"""Scenario files: what they say is checked, and what a seed draws from them stays inside what they say."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.sim.disturbances.disturbance_types import Patch
from diffdrive_mpc.sim.disturbances.scenario import SCENARIOS, Scenario, load_scenario

SHIPPED = SCENARIOS.names
PUSH = "pushes: [{force: 10.0, height: 0.09, start: 1.0, duration: 0.5}]"


def _written(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(f"description: mine\n{text}\n")
    return path


def _numbers(values: Any) -> list[float]:
    """Every number in nested data, in order."""
    if isinstance(values, dict):
        return [number for value in values.values() for number in _numbers(value)]
    if isinstance(values, (list, tuple)):
        return [number for value in values for number in _numbers(value)]
    return [values] if isinstance(values, float) else []


def test_every_disturbance_of_the_project_ships() -> None:
    expected = "start_offset patches split_friction payload slope weak_motor slipping_wheel battery_sag sensor_dropouts"
    assert {*expected.split(), "false_command", "push", "blocked", "none"} <= set(SHIPPED)
    assert not load_scenario("none").draw(0).kinds
    for name in set(SHIPPED) - {"none"}:
        assert load_scenario(name).draw(0).kinds, name


@pytest.mark.parametrize("name", SHIPPED)
def test_every_disturbance_has_begun_or_is_over_well_before_the_shortest_trajectory_ends(name: str) -> None:
    shortest = min((load_trajectory(path) for path in ("circle", "square", "s", "cane")), key=lambda r: r.duration)
    for seed in range(20):
        scenario = load_scenario(name).draw(seed)
        assert all((start if end == math.inf else end) <= shortest.duration - 3.0 for start, end in scenario.spans)
        length = shortest.sample([shortest.duration]).arc_length[0]
        assert all(patch.start + (patch.length or 0.0) <= length - 1.0 for patch in scenario.patches)


def test_the_start_offset_is_exact_and_the_first_seeds_take_every_sign() -> None:
    drawn = [load_scenario("start_offset").draw(seed).start_offset for seed in range(4)]
    pairs = {(offset.across, round(np.degrees(offset.heading), 3)) for offset in drawn if offset}
    assert pairs == {(across, heading) for across in (-0.2, 0.2) for heading in (-20.0, 20.0)}


@given(seed=st.integers(0, 10_000), low=st.floats(0.1, 5.0), width=st.floats(0.0, 5.0))
def test_drawn_values_lie_in_their_ranges_and_choices(
    tmp_path_factory: pytest.TempPathFactory, seed: int, low: float, width: float
) -> None:
    force, torque = [low, low + width], [[-2.0, -1.0], [1.0, 2.0]]
    text = f"pushes: [{{force: {force}, yaw_torque: {{one_of: {torque}}}, height: 0, start: 1, duration: 1}}]"
    file = load_scenario(_written(tmp_path_factory.mktemp("scenario"), text))
    (push,) = file.draw(seed).pushes
    assert low <= push.force <= low + width
    assert 1.0 <= abs(push.yaw_torque) <= 2.0
    assert file.draw(seed) == file.draw(seed)


@pytest.mark.parametrize("name", sorted(set(SHIPPED) - {"none"}))
def test_another_seed_draws_other_values(name: str) -> None:
    drawn = [load_scenario(name).draw(seed) for seed in range(12)]
    assert drawn[0] == load_scenario(name).draw(0)
    assert len({tuple(_numbers(scenario.model_dump())) for scenario in drawn}) > 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pushs: []", "unknown key 'pushs'; did you mean 'pushes'?"),
        (PUSH.replace("force", "forse"), "did you mean 'pushes.force'?"),
        (PUSH.replace("10.0", "-1.0"), "pushes.0.force: Input should be greater than or equal to 0 (found -1.0)"),
        (PUSH.replace("10.0", "[3.0, 1.0]"), "pushes.0.force: a range goes from low to high (found [3.0, 1.0])"),
        (PUSH.replace("10.0", "[-3.0, 1.0]"), "pushes.0.force: Input should be greater than or equal to 0"),
        (PUSH.replace("10.0", "[1.0, .nan]"), "pushes.0.force: a range goes from low to high"),
        (PUSH.replace("10.0", "[1.0, .inf]"), "pushes.0.force: Input should be a finite number"),
        (PUSH.replace("10.0", "[1.0, 2.0, 3.0]"), "pushes.0.force"),
        (PUSH.replace("10.0", "{one_of: []}"), "pushes.0.force: one_of takes a list of at least one value (found [])"),
        (PUSH.replace("10.0", "{one_of: 3}"), "pushes.0.force: one_of takes a list"),
        (PUSH.replace("10.0", "{one_of: [1.0, 2.0, -1.0]}"), "pushes.0.force: Input should be greater"),
        (PUSH.replace("10.0", "{one_of: [[1.0, 2.0], [-1.0, 3.0]]}"), "pushes.0.force: Input should be greater"),
        (PUSH.replace(", duration: 0.5", ""), "key 'pushes.0.duration' is missing"),
        (PUSH.replace("start: 1.0", "start: -1.0"), "pushes.0.start"),
        ("weak_motors: [{wheel: front, factor: 0.5, start: 1.0}]", "Input should be 'front_left', 'front_right'"),
        ("weak_motors: [{wheel: front_left, factor: 1.5, start: 1.0}]", "weak_motors.0.factor"),
        ("drop_outs: [{sensor: camera, start: 1.0, duration: 1.0}]", "Input should be 'pose', 'wheels' or 'gyro'"),
        ("patches: [{start: 1.0, friction: 0.0}]", "patches.0.friction: Input should be greater than 0"),
        ("payload: {mass: 0.0, radius: 0.1}", "payload.mass"),
        ("slope: {angle: 1.2}", "slope.angle"),
        ("battery: {start: 1.0, duration: 1.0, after: 0.0}", "battery.after"),
    ],
)
def test_a_mistake_gives_one_line_that_names_the_place(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load_scenario(_written(tmp_path, text))
    assert message in str(caught.value)
    assert "mine.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_name_is_refused_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"unknown scenario 'pusch': give one of .*; did you mean 'push'\?"):
        load_scenario("pusch")


def test_what_lasts_to_the_end_of_the_run_has_an_endless_span() -> None:
    passing = {"wheel": "front_left", "friction": 0.1, "start": 2.0, "duration": 1.5}
    lasting = {"wheel": "front_left", "factor": 0.1, "start": 4.0}
    scenario = check(
        Scenario,
        {
            "description": "several",
            "slipping_wheels": [passing],
            "weak_motors": [lasting],
            "battery": {"start": 3.0, "duration": 2.0, "after": 0.5},
            "payload": {"mass": 1.0, "radius": 0.1},
        },
        "test",
    )
    assert set(scenario.spans) == {(2.0, 3.5), (4.0, math.inf), (3.0, math.inf), (0.0, math.inf)}
    assert load_scenario("start_offset").draw(0).spans == ((0.0, 0.0),)


@pytest.mark.parametrize("text", ["patches: [{start: 1.0}]", "patches: [{start: 1.0, friction: 0.3, factor: 0.5}]"])
def test_a_patch_has_a_friction_of_its_own_or_a_share_of_the_floors(text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"patches\.0: give either friction or factor"):
        load_scenario(_written(tmp_path, text))
    assert Patch(start=1.0, friction=0.3).coefficient(0.8) == 0.3
    assert Patch(start=1.0, factor=0.25).coefficient(0.8) == pytest.approx(0.2)
