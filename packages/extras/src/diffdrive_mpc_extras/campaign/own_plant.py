"""Simulated plant of the robot that a configuration is for."""

from __future__ import annotations

from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.sim.plants.identified_robot import ROBOT_FILE
from diffdrive_mpc.sim.plants.names import MODEL, PHYSICS

TWIN_FILE = "plant.yaml"


def own_plant(config: str) -> str:
    """Return the name of the plant of a configuration.

    The plant of a shipped configuration is the robot of the papers. For a file it is the twin or the identified robot
    in the same folder, written by `twin` or `identify`. The twin is preferred because it also models mass and surface.

    Raises ConfigError if the configuration cannot be loaded, or neither file exists.
    """
    if is_shipped(config):
        return PHYSICS
    load_config(config)
    folder = Path(config).parent
    for kind, name in ((PHYSICS, TWIN_FILE), (MODEL, ROBOT_FILE)):
        if (folder / name).is_file():
            return f"{kind}:{(folder / name).resolve()}"
    raise ConfigError(
        f"{config}: its folder has neither {TWIN_FILE} (twin) nor {ROBOT_FILE} (identify); "
        f"give --plant, such as {MODEL}:FILE or {PHYSICS}:FILE"
    )
