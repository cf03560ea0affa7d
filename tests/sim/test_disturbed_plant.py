"""What a scenario does to any plant, and what a disturbed run promises."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_parts import ConstantTwist, FeedForward, trace

from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.models.interface import Measurement
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc.sim.disturbances.scenario import SCENARIOS, Scenario, load_scenario
from diffdrive_mpc.sim.plants.disturbed_plant import DisturbedPlant

PLANTS = ["mujoco", "model:ssm"]
DT = load_robot().sample_time
SHIPPED = sorted({path.stem for path in SCENARIOS.glob("*.yaml")} - {"none"})


def _scenario(**parts: Any) -> Scenario:
    return check(Scenario, {"description": "test", **parts}, "test")


def _disturbed(name: str, **parts: Any) -> DisturbedPlant:
    return DisturbedPlant(make_plant(name, sensors="perfect"), _scenario(**parts), load_robot())


@pytest.mark.parametrize("name", ["patches", "push", "blocked", "sensor_dropouts"])
def test_same_seed_same_disturbed_run_bit_for_bit(name: str) -> None:
    plant = make_plant("mujoco", seed=5, scenario=name)
    first = trace(plant, 300)
    assert isinstance(plant, DisturbedPlant)
    assert plant.disturbance is not None
    assert first == trace(make_plant("mujoco", seed=5, scenario=name), 300)
    plant.reset([0.0, 0.0, 0.0])
    assert trace(plant, 300) == first


def test_what_has_not_happened_yet_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "later.yaml"
    path.write_text(
        "description: all of it after the drive\n"
        "patches: [{start: 90, friction: 0.3}]\n"
        "weak_motors: [{wheel: front_left, factor: 0.1, start: 90}]\n"
        "slipping_wheels: [{wheel: front_left, friction: 0.1, start: 90}]\n"
        "battery: {start: [90, 95], duration: 1, after: 0.5}\n"
        "drop_outs: [{sensor: pose, start: 90, duration: 1}]\n"
        "false_commands: [{v: 1, omega: 1, start: 90, duration: 1}]\n"
        "pushes: [{force: 50, height: 0, start: 90, duration: 1}]\n"
        "blockades: [{start: 90, duration: 1, height: 0, "
        "stiffness: 10, damping: 1, yaw_stiffness: 1, yaw_damping: 1}]\n"
    )
    plant = make_plant("mujoco", seed=2, scenario=path)
    assert trace(plant, 150) == trace(make_plant("mujoco", seed=2), 150)
    assert isinstance(plant, DisturbedPlant)
    assert plant.disturbance is None


@pytest.mark.parametrize("name", PLANTS)
def test_the_start_offset_is_taken_in_the_frame_of_the_reference(name: str) -> None:
    plant = _disturbed(name, start_offset={"along": 0.3, "across": 0.2, "heading": -0.4})
    plant.reset([1.0, 2.0, np.pi / 2])
    np.testing.assert_allclose(plant.true_pose, [1.0 - 0.2, 2.0 + 0.3, np.pi / 2 - 0.4], atol=1e-12)
    np.testing.assert_allclose(np.asarray(plant.measure().pose.value), plant.true_pose, atol=1e-12)  # type: ignore[union-attr]
    assert plant.disturbance == (0.0, 0.0)


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize(
    ("sensor", "fields"), [("pose", {"pose"}), ("wheels", {"wheel_twist", "wheel_speeds"}), ("gyro", {"yaw_rate"})]
)
def test_a_drop_out_empties_its_fields_and_no_others(name: str, sensor: str, fields: set[str]) -> None:
    plant = _disturbed(name, drop_outs=[{"sensor": sensor, "start": 0.2, "duration": 0.3}])
    for _ in range(40):
        time, measurement = plant.time, plant.measure()
        for field in ("pose", "wheel_twist", "wheel_speeds", "yaw_rate"):
            lost = field in fields and 0.2 <= time < 0.5
            assert (getattr(measurement, field) is None) == lost, (field, time)
        plant.advance([0.3, 0.2])


@pytest.mark.parametrize("name", PLANTS)
def test_a_false_command_moves_the_robot_and_nobody_is_told(name: str) -> None:
    false = {"v": 0.0, "omega": 1.0, "start": 10 * DT - 1e-6, "duration": 0.5}
    plant, told = _disturbed(name, false_commands=[false]), make_plant(name, sensors="perfect")
    for k in range(60):
        acts = 10 <= k < 10 + int(np.ceil(0.5 / DT))
        plant.advance([0.4, 0.0])
        told.advance([0.0, 1.0] if acts else [0.4, 0.0])
        np.testing.assert_array_equal(plant.true_pose, told.true_pose)
        assert plant.measure().sent == (0.4, 0.0)
    assert plant.true_pose[2] > 0.3


def test_a_command_beyond_the_limits_is_told_as_the_link_clips_it() -> None:
    plant = _disturbed("model:ssm", drop_outs=[{"sensor": "gyro", "start": 9.0, "duration": 1.0}])
    assert plant.measure().sent is None
    plant.advance([9.0, -9.0])
    assert plant.measure().sent == (load_robot().limits.v, -load_robot().limits.omega)
    with pytest.raises(ValueError, match="give two finite numbers"):
        plant.advance([np.nan, 0.0])


def test_the_plant_tells_what_has_happened_so_far() -> None:
    push = {"sensor": "gyro", "start": 0.5, "duration": 0.4}
    later = {"v": 0.1, "omega": 0.0, "start": 1.5, "duration": 0.1}
    plant = _disturbed("model:ssm", drop_outs=[push], false_commands=[later])
    told = {}
    for _ in range(100):
        told[plant.time] = plant.disturbance
        plant.advance([0.0, 0.0])
    for time, span in told.items():
        if time < 0.5:
            assert span is None
        elif time < 1.5:
            assert span == (0.5, min(time, 0.9))
        else:
            assert span == (0.5, pytest.approx(min(time, 1.6)))


def test_what_lasts_to_the_end_is_never_over_and_hides_no_other_end() -> None:
    push = {"force": 20.0, "height": 0.09, "start": 0.2, "duration": 0.1}
    weak = {"wheel": "front_left", "factor": 0.5, "start": 0.1}
    plant = make_plant("mujoco", sensors="perfect")
    alone, both = (
        DisturbedPlant(plant, _scenario(weak_motors=[weak], pushes=pushes), load_robot()) for pushes in ([], [push])
    )
    both.reset(np.zeros(3))
    for _ in range(25):
        both.advance([0.0, 0.0])
    assert alone.disturbance == (0.1, np.inf)
    assert both.disturbance == (0.1, pytest.approx(0.3))


class _Remembers(FeedForward):
    """Keeps what it was given."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[Measurement] = []

    def step(self, t: float, measurement: Measurement) -> Any:
        self.seen.append(measurement)
        return super().step(t, measurement)


def test_the_run_carries_the_disturbance_and_the_measurements_as_given() -> None:
    reference, controller = ConstantTwist(0.4, 0.0, 3.0), _Remembers()
    run = simulate(controller, make_plant("model:ssm", seed=1, scenario="start_offset"), reference)
    assert run.disturbance == (0.0, 0.0)
    assert run.measurements == tuple(controller.seen)
    assert abs(run.errors.lateral[0]) == pytest.approx(0.2)
    assert simulate(FeedForward(), make_plant("model:ssm"), reference).disturbance is None


@pytest.mark.parametrize("name", SHIPPED)
def test_velocity_models_refuse_what_needs_mass_and_wheels(name: str) -> None:
    needs = load_scenario(name).draw(0).physical
    if not needs:
        assert isinstance(make_plant("model:ssm", scenario=name), DisturbedPlant)
        return
    with pytest.raises(ConfigError) as caught:
        make_plant("model:ssm", scenario=name)
    assert f"scenario '{name}' needs a plant with mass, wheels and motors ({', '.join(needs)})" in str(caught.value)
    assert "use 'mujoco'" in str(caught.value)
