"""A plant of a velocity model with base effects moves as the model file says, and as before where there are none."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from diffdrive_mpc import ModelError, load_model, make_plant
from diffdrive_mpc.models.base_effects import BaseEffects, PoseMount, respond
from diffdrive_mpc.models.load import PARAMETERS, load_base_effects
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.plants.base_motion import BaseMotion
from diffdrive_mpc.sim.plants.model_plant import ModelPlant
from diffdrive_mpc.sim.plants.open_loop import random_commands
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set

DT = load_robot().sample_time
EFFECTS = {
    "twist_slew": {"v": 0.8, "omega": 1.5},
    "wheel_command": {"track": 0.5, "resolution": 0.02, "coasting_speed": 0.08},
    "yaw_relaxation": {"angle": 0.04},
    "veer": {"yaw_per_metre": -0.05},
    "pose_mount": {"ahead": 0.1},
}


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "base.yaml"
    data = yaml.safe_load((PARAMETERS / "sm.yaml").read_text())
    file.write_text(yaml.safe_dump({**data, "base_effects": EFFECTS}))
    return file


def driven(plant, commands):
    """Twists (K, 2) of gyro and encoders before each command, and the last pose."""
    seen = []
    for command in commands:
        measurement = plant.measure()
        seen.append([measurement.wheel_twist.value[0], float(measurement.yaw_rate.value)])
        plant.advance(command)
    return np.array(seen), plant.true_pose


def test_plant_of_a_file_with_effects_is_the_free_run_of_that_file(path):
    commands = random_commands(4, duration=6.0)
    seen, _ = driven(make_plant(f"model:{path}", surface="ideal", sensors="perfect"), commands)
    response = respond(load_model(path), load_base_effects(path), commands, DT)
    np.testing.assert_allclose(seen[:, 0], response.wheels[:, 0], atol=1e-12)
    np.testing.assert_allclose(seen[:, 1], response.body[:, 1], atol=1e-12)


def test_without_effects_and_with_a_pose_mount_alone_the_run_is_the_same_bit_for_bit():
    commands = random_commands(4, duration=3.0)
    slip, sensors = load_surface("default").slip, load_sensor_set("slam")
    runs = [
        driven(ModelPlant(load_model("ssm"), slip, sensors, 3, effects=effects), commands)
        for effects in (None, BaseEffects(pose_mount=PoseMount(ahead=0.2)))
    ]
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_array_equal(runs[0][1], runs[1][1])


def test_a_reversal_costs_heading_twice_the_angle_of_the_tyres():
    """Settled turns to both sides: the wheels come back to where they were, the body lags twice the angle."""
    effects = BaseEffects.model_validate({"yaw_relaxation": {"angle": 0.05}})
    slip, sensors = load_surface("ideal").slip, load_sensor_set("perfect")
    turn = np.concatenate([np.tile([0.0, 1.0], (200, 1)), np.tile([0.0, -1.0], (200, 1))])
    stiff = driven(ModelPlant(load_model("sm"), slip, sensors), turn)[1][2]
    soft = driven(ModelPlant(load_model("sm"), slip, sensors, effects=effects), turn)[1][2]
    # It begins with tyres that are not twisted and ends with tyres twisted to the right.
    assert soft - stiff == pytest.approx(0.05, abs=1e-3)


def test_same_seed_same_run_with_effects(path):
    commands = random_commands(4, duration=2.0)
    first, second = (driven(make_plant(f"model:{path}", sensors="slam", seed=5), commands) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_a_network_is_a_plant_that_obeys_it_sample_by_sample():
    model, random = load_model("lstm"), np.random.default_rng(0)
    motion, commands = BaseMotion(model, BaseEffects(), model.dt), random.uniform(-1, 1, (50, 2))
    before = np.vstack([np.zeros(2), *(motion.advance(command).wheels for command in commands)])
    assert before[:-1] == pytest.approx(model.simulate(commands), abs=1e-12)
    with pytest.raises(ModelError, match="as a plant of 0.04 s"):
        BaseMotion(model, BaseEffects(), 0.04)
