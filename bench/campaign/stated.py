"""What plant, floor and sensors of a run say, for factors that are spread about it."""

from __future__ import annotations

from collections.abc import Mapping

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.sim.plants.simulated_robot import DEFAULT, digital_twin, load_simulated_robot
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set


def stated(key: str, factors: Mapping[str, object]) -> float:
    """The number behind a dotted key of robot, floor or sensors, as the files that `factors` name have it.

    Raises ConfigError if there is none.
    """
    group, _, rest = key.partition(".")
    kind, _, name = str(factors.get("plant", "mujoco")).partition(":")
    robot = load_simulated_robot(name).model_dump() if kind == "mujoco" and name else digital_twin()
    surface, sensors = str(factors.get("surface", DEFAULT)), str(factors.get("sensors", DEFAULT))
    data: object = robot
    if group == "surface":
        floor = load_surface(surface).model_dump()
        if surface == DEFAULT and robot.get("friction"):
            floor["friction"] = robot["friction"]
        data = floor
    elif group == "sensors":
        data = robot["sensors"] if sensors == DEFAULT else load_sensor_set(sensors).model_dump()
    elif kind != "mujoco":
        raise ConfigError(f"spread.{key}: the plant '{factors.get('plant')}' has no robot file; leave it out")
    for part in rest.split("."):
        data = data.get(part) if isinstance(data, Mapping) else None
    if isinstance(data, bool) or not isinstance(data, (int, float)):
        raise ConfigError(f"spread.{key}: there is no number there that could be spread")
    return float(data)
