"""Plant that belongs to a configuration: the simulated stand-in of the robot that the configuration is for."""

from __future__ import annotations

from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.sim.plants.identified_robot import ROBOT_FILE
from diffdrive_mpc.sim.plants.names import MODEL, PHYSICS

TWIN_FILE = "plant.yaml"


def own_plant(config: str) -> str:
    """Return the name of the plant of a configuration.

    A shipped configuration has the robot of the papers. A file has the twin or the identified robot in its folder, as
    `twin` and `identify` write them; the twin comes first, as its physics also covers changes of mass and surface.

    Raises ConfigError if neither file exists.
    """
    if is_shipped(config):
        return PHYSICS
    folder = Path(config).parent
    for kind, name in ((PHYSICS, TWIN_FILE), (MODEL, ROBOT_FILE)):
        if (folder / name).is_file():
            return f"{kind}:{(folder / name).resolve()}"
    raise ConfigError(
        f"{config}: no plant belongs to it, as its folder has neither {TWIN_FILE} (twin) nor {ROBOT_FILE} (identify); "
        f"give --plant, such as {MODEL}:FILE or {PHYSICS}:FILE"
    )
